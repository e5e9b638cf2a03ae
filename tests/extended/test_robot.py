"""docs/robot.md: a policy's checkpoint in LeRobot's own `lerobot-rollout`, on a simulated arm."""

import json
from collections.abc import Callable
from pathlib import Path

import pytest
import torch
from lerobot.datasets.lerobot_dataset import LeRobotDataset
from torch import Tensor

from lerobot_wm.policies.wm_bc.modeling_wm_bc import WMBCPolicy
from tests.documents import commands, with_flags
from tests.extended.arm import JOINTS, Arm, run_rollout
from tests.flags import SMALL_WORLD_MODEL
from tests.recording import camera, record, train_flags, vector

TASKS = ("Pick up the cup", "Open the lid")
CAMERAS = {"front": [48, 64], "wrist": [32, 32]}
FEATURES = {
    **{f"observation.images.{name}": camera(*size) for name, size in CAMERAS.items()},
    "observation.state": vector(len(JOINTS)),
    "action": vector(len(JOINTS)),
}


@pytest.fixture(scope="module")
def policies(
    tmp_path_factory: pytest.TempPathFactory, lerobot_wm_command: Callable[..., None]
) -> dict[int, Path]:
    """Checkpoints of wm_bc on two cameras, by their number of tasks."""
    folder = tmp_path_factory.mktemp("robot")
    paths = {}
    for n_tasks in (2, 1):
        dataset = record(folder / f"data_{n_tasks}", FEATURES, [(task, 12) for task in TASKS[:n_tasks]])
        flags = f"{train_flags(dataset)} --batch_size=4 --steps=3"
        if n_tasks == 2:
            lerobot_wm_command(
                f"train --policy.type=wm_rssm {flags} {SMALL_WORLD_MODEL} --policy.window_length=6",
                f"--output_dir={folder / 'wm'}",
            )
        lerobot_wm_command(
            f"train --policy.type=wm_bc {flags} --output_dir={folder / f'bc_{n_tasks}'}",
            f"--policy.world_model_path={folder / 'wm/checkpoints/last/pretrained_model'}",
        )
        paths[n_tasks] = folder / f"bc_{n_tasks}/checkpoints/last/pretrained_model"
    return paths


@pytest.fixture
def rollout(tmp_path: Path) -> Callable[..., Arm]:
    """`lerobot-rollout`, given a command of the document, on a simulated arm, which is returned."""

    def run(words: list[str], *flags: str, image_sizes: dict[str, list[int]] = CAMERAS) -> Arm:
        return run_rollout([*words, *flags], tmp_path, image_sizes)

    return run


def base(policy: Path, **flags: object) -> list[str]:
    """The document's first command, a fraction of a second long."""
    return with_flags(commands("docs/robot.md")[0], **{"policy.path": policy, "duration": 0.1, **flags})


def act(policy: WMBCPolicy, dataset: LeRobotDataset, index: int) -> Tensor:
    """What the policy does, (A,), on a frame of a dataset."""
    item = dataset[index]
    keys = [key for key in item if key.startswith("observation.")]
    return policy.select_action({**{key: item[key][None] for key in keys}, "task": [item["task"]]})[0]


def differ(action: Tensor, other: Tensor) -> bool:
    return bool((action - other).abs().max() > 1e-3)


def test_the_filter_starts_anew_with_each_episode_and_only_then(
    policies: dict[int, Path], rollout: Callable[..., Arm], tmp_path: Path
) -> None:
    """The recorded actions are those of a policy that is reset where an episode begins, and nowhere else."""
    flags = {"num_episodes": 2, "episode_time_s": 1, "reset_time_s": 0, "root": tmp_path / "rollout"}
    words = with_flags(
        commands("docs/robot.md")[1],
        **{"policy.path": policies[2], **{f"dataset.{name}": value for name, value in flags.items()}},
    )
    rollout(words, "--dataset.video=false", "--strategy.reset_to_initial_position=false")
    [root] = tmp_path.glob("rollout*/meta")
    dataset = LeRobotDataset("test/rollout", root=root.parent)
    assert dataset.num_episodes == 2
    first, second = (
        range(episode["dataset_from_index"], episode["dataset_to_index"]) for episode in dataset.meta.episodes
    )

    def new_policy() -> WMBCPolicy:
        return WMBCPolicy.from_pretrained(policies[2]).eval()

    for episode in (first, second):
        policy = new_policy()
        for index in episode:
            torch.testing.assert_close(dataset[index]["action"], act(policy, dataset, index))
    # Memory matters: the same frames are acted on otherwise by a policy without it, and by one with too much of it.
    assert differ(dataset[first[1]]["action"], act(new_policy(), dataset, first[1]))
    policy = new_policy()
    for index in (*first, second[0]):
        action = act(policy, dataset, index)
    assert differ(dataset[second[0]]["action"], action)


def test_a_policy_of_one_task_needs_no_task(policies: dict[int, Path], rollout: Callable[..., Arm]) -> None:
    words = [word for word in base(policies[1]) if not word.startswith("--task=")]
    arm = rollout(words)
    assert any(arm.joints.values())
    assert not arm.is_connected


def test_cameras_of_other_names_are_renamed(policies: dict[int, Path], rollout: Callable[..., Arm]) -> None:
    sizes = {"cam0": CAMERAS["front"], "cam1": CAMERAS["wrist"]}
    with pytest.raises(ValueError, match=r"Visual feature mismatch"):
        rollout(base(policies[2]), image_sizes=sizes)
    names = {f"observation.images.cam{i}": f"observation.images.{name}" for i, name in enumerate(CAMERAS)}
    arm = rollout(base(policies[2]), f"--rename_map={json.dumps(names)}", image_sizes=sizes)
    assert any(arm.joints.values())


@pytest.mark.parametrize(
    ("image_sizes", "flags", "message"),
    [
        ({"front": [48, 64]}, [], r"observation\.images\.wrist; the observation has .*front\. Add"),
        (
            {"front": [48, 48], "wrist": [32, 32]},
            [],
            r"front' is \(3, 48, 48\).*height 48 and width 64",
        ),
        (CAMERAS, ["--robot.n_joints=2"], r"'observation\.state' has 2 numbers.*trained with 3"),
        (CAMERAS, ["--task="], r"no 'task' strings.*Pick up the cup.*Open the lid.*--task"),
        (CAMERAS, ["--task=Juggle"], r"Unknown task \['Juggle'\].*Pick up the cup"),
    ],
)
def test_what_does_not_fit_is_named_before_the_arm_moves(
    image_sizes: dict[str, list[int]],
    flags: list[str],
    message: str,
    policies: dict[int, Path],
    rollout: Callable[..., Arm],
) -> None:
    words = [word for word in base(policies[2]) if not word.startswith("--task=")]
    task = [] if any(flag.startswith("--task") for flag in flags) else [f"--task={TASKS[0]}"]
    with pytest.raises(ValueError, match=message):
        rollout(words, *flags, *task, image_sizes=image_sizes)
    assert not any(Arm.made[0].joints.values())
    assert not Arm.made[0].is_connected
