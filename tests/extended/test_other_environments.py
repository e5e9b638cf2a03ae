"""docs/other_environments.md at a size for tests: PushT and ALOHA, from the dataset to lerobot-eval."""

import json
import runpy
import sys
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch
from lerobot.configs import PreTrainedConfig
from lerobot.datasets.lerobot_dataset import LeRobotDataset
from lerobot.scripts import lerobot_eval

from tests.documents import ROOT, commands, with_flags
from tests.flags import SMALL_WORLD_MODEL

DOCUMENT = "docs/other_environments.md"
EXAMPLES = ROOT / "examples"
PUSHT = {"observation.image": (96, 96, 3), "observation.state": (2,), "action": (2,)}
ALOHA = {"observation.images.top": (480, 640, 3), "observation.state": (14,), "action": (14,)}
LABELS = {"next.reward": "float32", "next.success": "bool", "next.done": "bool"}


@pytest.fixture
def run_example(monkeypatch: pytest.MonkeyPatch) -> Callable[..., None]:
    """A program of examples/ as a function of its flags."""

    def run(program: str, *flags: str) -> None:
        monkeypatch.syspath_prepend(EXAMPLES)
        monkeypatch.setattr(sys, "argv", [program, *flags])
        runpy.run_path(str(ROOT / program), run_name="__main__")

    return run


def needs(package: str) -> None:
    pytest.importorskip(
        package, reason=f"{package} is not installed: scripts/setup.sh installs it, pip: {DOCUMENT}"
    )


def small(words: list[str]) -> list[str]:
    """The command with a few short episodes, a few steps and a small world model."""
    if words[0] == "python":
        return [*with_flags(words, n_episodes=2), "--env.episode_length=5"]
    if words[0] == "lerobot-eval":
        few = with_flags(words, **{"eval.n_episodes": 1, "eval.batch_size": 1})
        return [*few, "--env.episode_length=2", "--policy.device=cpu"]
    few = [*with_flags(words, steps=2, batch_size=2), "--policy.device=cpu", "--num_workers=0"]
    if "--dataset.repo_id=lerobot/pusht" in words:  # on the Hub
        few = [*with_flags(few, **{"dataset.repo_id": "test/pusht"}), "--dataset.root=data/pusht"]
    if "--policy.type=wm_rssm" in words:
        few += [*SMALL_WORLD_MODEL.split(), "--policy.window_length=4"]
    return few


@pytest.mark.parametrize(
    ("environment", "features", "task"),
    [
        ("pusht", PUSHT, "PushT-v0"),
        pytest.param("aloha", ALOHA, "transfer_cube", marks=pytest.mark.slow),  # seconds for each step
    ],
)
def test_the_commands_work_as_written(
    environment: str,
    features: dict[str, tuple[int, ...]],
    task: str,
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
    lerobot_wm_command: Callable[..., None],
    run_example: Callable[..., None],
) -> None:
    needs(f"gym_{environment}")
    monkeypatch.chdir(tmp_path)
    chain = [words for words in commands(DOCUMENT) if any(environment in word for word in words[1:])]
    chain = [words for words in chain if words[0] != "pip"]
    if environment == "pusht":
        record = "python examples/record_env.py --env.type=pusht --repo_id=test/pusht --root=data/pusht --n_episodes=2"
        chain.insert(0, record.split())
    assert [words[0] for words in chain] == ["python", "lerobot-wm", "lerobot-wm", "lerobot-eval"]
    for words in map(small, chain):
        if words[0] == "python":
            run_example(*words[1:])
        elif words[0] == "lerobot-wm":
            lerobot_wm_command(*words[1:])
        else:
            monkeypatch.setattr(sys, "argv", words)
            lerobot_eval.main()

    dataset = LeRobotDataset(f"test/{environment}", root=tmp_path / "data" / environment)
    recorded = {key: tuple(dataset.meta.features[key]["shape"]) for key in features}
    assert recorded == features
    assert {key: dataset.meta.features[key]["dtype"] for key in LABELS} == LABELS
    assert list(dataset.meta.tasks.index) == [task]
    assert dataset.num_episodes == 2
    policy = PreTrainedConfig.from_pretrained(f"outputs/{environment}_bc/checkpoints/last/pretrained_model")
    shapes = {key: feature.shape for key, feature in policy.input_features.items()}
    camera, state = list(features)[:2]
    height, width, channels = features[camera]
    assert shapes == {camera: (channels, height, width), state: features[state]}
    evaluated = json.loads(Path(f"outputs/{environment}_eval/eval_info.json").read_text())
    assert evaluated["overall"]["n_episodes"] == 1


def test_a_recording_is_what_the_environment_did(tmp_path: Path, run_example: Callable[..., None]) -> None:
    """Played again in PushT's own environment, the recorded actions lead to what was recorded."""
    needs("gym_pusht")
    import gymnasium as gym

    root = tmp_path / "pusht"
    flags = f"--env.type=pusht --repo_id=test/pusht --root={root} --n_episodes=2 --seed=3 --env.episode_length=150"
    run_example("examples/record_env.py", *flags.split())
    dataset = LeRobotDataset("test/pusht", root=root)
    rows = dataset.hf_dataset.with_format("numpy")
    env = gym.make("gym_pusht/PushT-v0", obs_type="pixels_agent_pos", max_episode_steps=150)
    ends = []
    for episode, seed in enumerate((3, 4)):
        observation, _ = env.reset(seed=seed)
        for index in np.flatnonzero(np.asarray(rows["episode_index"]) == episode).tolist():
            frame: dict[str, Any] = rows[index]
            np.testing.assert_array_equal(
                frame["observation.state"], observation["agent_pos"].astype(np.float32)
            )
            if index % 10 == 0:
                seen = torch.from_numpy(observation["pixels"]).permute(2, 0, 1) / 255
                assert (dataset[index]["observation.image"] - seen).abs().mean() < 0.02  # it is a video
            observation, reward, terminated, truncated, info = env.step(frame["action"])
            assert frame["next.reward"] == np.float32(reward)
            assert frame["next.success"] == info["is_success"]
            assert frame["next.done"] == terminated
        ends.append((bool(terminated), bool(truncated)))
    assert ends == [(True, False), (False, True)]  # one ended in success, the other by its time limit


def test_the_script_pushes_the_block_to_its_goal(monkeypatch: pytest.MonkeyPatch) -> None:
    needs("gym_pusht")
    import gymnasium as gym

    monkeypatch.syspath_prepend(EXAMPLES)
    push_to_goal = runpy.run_path(str(EXAMPLES / "env_scripts.py"))["PushToGoal"]
    env = gym.make("gym_pusht/PushT-v0", obs_type="state", max_episode_steps=300)
    coverage = []
    for seed in range(6):
        _, info = env.reset(seed=seed)
        script = push_to_goal(np.random.default_rng(seed), env.unwrapped)
        best, ended = 0.0, False
        while not ended:
            batched = {key: info[key][None] for key in ("block_pose", "goal_pose")}
            action = script(info["pos_agent"], batched)
            _, reward, terminated, truncated, info = env.step(action)
            best, ended = max(best, float(reward)), terminated or truncated
        coverage.append(best)
    assert np.mean(coverage) > 0.4  # random pushes: about 0.1


def test_the_arms_hand_over_the_cube(monkeypatch: pytest.MonkeyPatch) -> None:
    needs("gym_aloha")
    import gymnasium as gym
    from dm_control.mujoco.engine import Physics

    # Drawing is nearly all the time an episode takes, and the script does not look.
    monkeypatch.setattr(Physics, "render", lambda *args, **size: np.zeros((480, 640, 3), np.uint8))
    monkeypatch.syspath_prepend(EXAMPLES)
    hand_over = runpy.run_path(str(EXAMPLES / "aloha_script.py"))["HandOver"]
    env = gym.make("gym_aloha/AlohaTransferCube-v0", obs_type="pixels_agent_pos", max_episode_steps=400)
    actions, successes = [], 0
    for seed in range(5):
        observation, info = env.reset(seed=seed)
        script, ended = hand_over(np.random.default_rng(seed), env.unwrapped), False
        while not ended:
            actions.append(script(observation["agent_pos"], info))
            observation, _, terminated, truncated, info = env.step(actions[-1])
            ended = terminated or truncated
        successes += info["is_success"]
    assert successes == 5
    space = env.action_space
    assert isinstance(space, gym.spaces.Box)
    assert all(action.shape == space.shape for action in actions)


@pytest.mark.parametrize(
    ("flags", "error", "message"),
    [
        (
            "--env.type=aloha",  # LeRobot's own default task is another
            ValueError,
            r"AlohaInsertion-v0 has no script in examples/env_scripts\.py.*PushT-v0, AlohaTransferCube-v0",
        ),
        ("--env.type=pusht", FileExistsError, r"is there already: choose another --root"),
    ],
)
def test_what_cannot_be_recorded_is_refused(
    flags: str, error: type[Exception], message: str, tmp_path: Path, run_example: Callable[..., None]
) -> None:
    with pytest.raises(error, match=message):
        run_example("examples/record_env.py", *flags.split(), "--repo_id=test/x", f"--root={tmp_path}")


def test_peoples_pusht_demonstrations_are_converted(run_example: Callable[..., None], tmp_path: Path) -> None:
    needs("gym_pusht")
    place, angles = np.array([200.0, 300.0]), [0.0, np.pi, np.pi, 0.5]
    state = np.array([[100, 100, *place, angle] for angle in angles], dtype=np.float32)
    image = np.random.default_rng(0).integers(0, 256, (4, 96, 96, 3), dtype=np.uint8)
    action, ends = np.full((4, 2), 120, dtype=np.float32), np.array([3, 4])
    np.savez(tmp_path / "file.npz", image=image, state=state, action=action, episode_ends=ends)
    root = tmp_path / "dataset"
    run_example(
        "examples/pusht_human.py",
        f"--file={tmp_path / 'file.npz'}",
        "--repo_id=test/people",
        f"--root={root}",
    )
    dataset = LeRobotDataset("test/people", root)
    assert dataset.num_episodes == 2
    corners = [dataset[t]["observation.environment_state"].numpy().reshape(8, 2) for t in range(4)]
    # Turned by half a turn about its place, whatever the frame before; and 0.5 radians turn lengths alone.
    np.testing.assert_allclose(corners[0] - place, place - corners[1], atol=1e-3)
    np.testing.assert_allclose(corners[2], corners[1], atol=1e-3)
    lengths = [np.linalg.norm(each - place, axis=1) for each in (corners[0], corners[3])]
    np.testing.assert_allclose(*lengths, atol=1e-3)
