"""What does not fit together is said before an image is decoded, an environment is built or training begins."""

import json
import shutil
from collections.abc import Callable
from pathlib import Path

import pytest
from lerobot.configs import PreTrainedConfig
from lerobot.configs.default import DatasetConfig
from lerobot.configs.train import TrainPipelineConfig
from lerobot.datasets.lerobot_dataset import LeRobotDataset

from lerobot_wm.commands.publish import PublishConfig, publish
from lerobot_wm.data.latents import RECORD_PATH
from lerobot_wm.data.source import SourceConfig
from lerobot_wm.encode.dataset import encode
from lerobot_wm.envs.configuration import MetaworldMTEnvConfig
from lerobot_wm.inspect.episodes import CheckpointConfig
from tests.extended.faults.breakage import set_entry
from tests.extended.faults.checkpoints import TASKS, WEIGHTS, last_line, load, make_checkpoint, record_demos
from tests.flags import TRAIN_FLAGS
from tests.recording import camera, vector

WRIST = "observation.images.wrist"
# What is unlike the demonstrations -> features that are changed.
UNLIKE = {
    "actions": {"action": vector(7)},
    "states": {"observation.state": vector(9)},
    "cameras": {"observation.image": None, WRIST: camera(64, 64)},
    "rewards": {"next.reward": None, "next.done": None},
    "two_cameras": {WRIST: camera(64, 64)},
    "grey": {"observation.image": camera(64, 64, "video")},
    "no_actions": {"action": None, "observation.other": vector(4)},
}
TRAIN = f"train {TRAIN_FLAGS} --steps=1 --batch_size=2 --output_dir={{out}} {{data}} "
GO_ON, NEW_BC = TRAIN + "--policy.path={%s}", TRAIN + "--policy.type=wm_bc --policy.world_model_path={%s}"
ENCODE = "encode --device=cpu --output_repo_id=a/b --output_root={out} {data} --world_model_path={%s}"
EVAL = "eval --policy.device=cpu --env.type=metaworld_mt --eval.n_episodes=1 --output_dir={out} --policy.path={%s} "

# Dataset, command, what the line names.
CASES: list[tuple[str, str, tuple[str, ...]]] = [
    ("actions", GO_ON % "wm_rssm", ("wm_rssm was trained with 'action' of size 4", "test/actions", "size 7")),
    ("actions", GO_ON % "wm_bc", ("wm_bc was trained with 'action' of size 4", "test/actions", "size 7")),
    (
        "actions",
        NEW_BC % "wm_rssm",
        ("wm_rssm was trained with 'action' of size 4", "test/actions", "size 7"),
    ),
    ("actions", ENCODE % "wm_bc", ("wm_rssm was trained with 'action' of size 4", "test/actions", "size 7")),
    (
        "states",
        GO_ON % "wm_bc",
        ("wm_bc was trained with 'observation.state' of size 4", "test/states", "size 9"),
    ),
    ("states", ENCODE % "proprio", ("'observation.state' of size 4", "test/states", "size 9")),
    ("no_actions", ENCODE % "wm_rssm", ("test/no_actions has no action", "wm_rssm")),
    (
        "cameras",
        GO_ON % "e2e_bc",
        ("e2e_bc", "observation.image;", f"test/cameras has {WRIST}", "--rename_map"),
    ),
    (
        "cameras",
        GO_ON % "wm_bc",
        ("wm_bc", "observation.image;", f"test/cameras has {WRIST}", "--rename_map"),
    ),
    ("cameras", ENCODE % "wm_rssm", ("wm_rssm", "observation.image;", f"test/cameras has {WRIST}")),
    (
        "rewards",
        TRAIN + "--policy.type=wm_iql --policy.world_model_path={wm_rssm}",
        ("wm_iql", "test/rewards has no next.reward and no next.done or next.success"),
    ),
    ("rewards", GO_ON % "e2e_iql", ("e2e_iql", "test/rewards has no next.reward", "--policy.type=e2e_bc")),
    (
        "demos",
        GO_ON % "wm_rssm" + " --policy.rssm.use_proprio=true --policy.rssm.kl_scale=0.5",
        (f"/{WEIGHTS} ", "proprio_decoder", "--policy.type=wm_rssm"),
    ),
    (
        "latents",
        GO_ON % "wm_bc" + " --policy.hidden_dims=[16] --policy.lr=0.001",
        (f"/{WEIGHTS} ", "actor", "[8]", "[16]", "--policy.type=wm_bc"),
    ),
    ("demos", GO_ON % "e2e_bc" + f" --policy.image_key={WRIST}", (WRIST, "observation.image")),
    (
        "two_cameras",
        GO_ON % "e2e_bc" + f" --rename_map={{{{'{WRIST}':'observation.image'}}}}",
        ("--rename_map", f"'observation.image' and '{WRIST}'"),
    ),
    (
        "two_cameras",
        ENCODE % "wm_rssm" + f" --rename_map={{{{'{WRIST}':'observation.image'}}}}",
        ("--rename_map", f"'observation.image' and '{WRIST}'"),
    ),
    (
        "demos",
        TRAIN + "--policy.type=e2e_bc --env.type=metaworld_mt --env.task=reach-v3 --env.image_size=32",
        ("'observation.image' is (3, 32, 32)", "(3, 64, 64)", "--env.image_size=64"),
    ),
    (
        "demos",
        GO_ON % "e2e_bc" + " --env.type=metaworld_mt --env.task=mt6",
        ("'Push and open a window'", str(list(TASKS))),
    ),
    ("grey", TRAIN + "--policy.type=e2e_bc", ("test/grey", "1 channels of observation.image")),
    ("demos", TRAIN + "--policy.type=e2e_bc --job.target=a10g-small", ("--job.target",)),
    ("demos", TRAIN + "--policy.type=wm_bc", ("--policy.type=wm_bc", "--policy.world_model_path=")),
    (
        "demos",
        TRAIN + "--policy.type=wm_rssm --env.type=metaworld_mt --env.task=reach-v3",
        ("wm_rssm", "--policy.type=wm_bc", "--env_eval_freq=0"),
    ),
    (
        "demos",
        GO_ON % "wm_rssm" + " --env.type=pusht",
        ("wm_rssm", "--policy.type=wm_bc", "--env_eval_freq=0"),
    ),
    ("latents", NEW_BC % "another", ("world model ", "encode")),
    ("latents of other tasks", NEW_BC % "wm_rssm", (str(RECORD_PATH), str([*reversed(TASKS)]))),
    ("latents", ENCODE % "wm_rssm", ("wm_rssm", "observation.image;", "test/latents has none")),
    (
        "",
        EVAL % "wm_bc" + "--env.task=reach-v3 --env.image_size=32",
        ("'observation.image' is (3, 32, 32)", "(3, 64, 64)"),
    ),
    (
        "",
        EVAL % "e2e_bc" + "--env.task=reach-v3 --env.camera_name=corner2,topview",
        ("e2e_bc", "observation.image;", "--env.camera_name=corner2,topview has "),
    ),
    ("", EVAL % "wm_bc" + "--env.task=mt6", ("'Push and open a window'", str(list(TASKS)))),
    ("", EVAL % "oracle" + "--env.task=reach-v3", ("no 'observation.environment_state'",)),
    ("", EVAL % "wm_rssm" + "--env.task=reach-v3", ("wm_rssm", "--policy.type=wm_bc")),
    ("", EVAL % "states_bc" + "--env.task=reach-v3", ("'observation.state' has 4 numbers", "9")),
    ("", EVAL % "actions_bc" + "--env.task=reach-v3", ("'action' of size 7", "size 4")),
    ("", EVAL % "one_task_less" + "--env.task=reach-v3", (f"/{WEIGHTS} ", "actor")),
    (
        "",
        (EVAL % "wm_bc").replace("--policy.path=", "--policy.type=wm_bc --policy.world_model_path=")
        + "--env.task=reach-v3",
        ("--policy.path=",),
    ),
]


@pytest.fixture(scope="module")
def datasets(tmp_path_factory: pytest.TempPathFactory) -> dict[str, LeRobotDataset]:
    """The demonstrations, and datasets that are unlike them, by name."""
    root = tmp_path_factory.mktemp("datasets")
    made = {name: record_demos(root / name, **changes) for name, changes in {"demos": {}, **UNLIKE}.items()}
    set_entry(root / "grey", "meta/info.json", ["features", "observation.image", "shape"], [64, 64, 1])
    return made


@pytest.fixture(scope="module")
def paths(datasets: dict[str, LeRobotDataset], tmp_path_factory: pytest.TempPathFactory) -> dict[str, Path]:
    """Checkpoints and latents by name."""
    root, demos = tmp_path_factory.mktemp("paths"), datasets["demos"]
    paths = {name: make_checkpoint(name, root / name, demos) for name in ("wm_rssm", "e2e_bc", "e2e_iql")}
    paths["another"] = make_checkpoint("wm_rssm", root / "another", demos, seed=1)
    paths["proprio"] = make_checkpoint("wm_rssm", root / "proprio", demos, use_proprio=True)
    paths["latents"] = root / "latents"
    latents = encode(load(paths["wm_rssm"], "wm_rssm"), demos, "test/latents", paths["latents"])
    paths["wm_bc"] = make_checkpoint("wm_bc", root / "wm_bc", latents, world_model_path=str(paths["wm_rssm"]))
    for name in ("actions", "states"):
        paths[f"{name}_bc"] = make_checkpoint("e2e_bc", root / f"{name}_bc", datasets[name])
    paths["oracle"] = shutil.copytree(paths["wm_bc"], root / "oracle")
    set_entry(paths["oracle"], "config.json", ["use_environment_state"], True)
    paths["one_task_less"] = shutil.copytree(paths["e2e_bc"], root / "one_task_less")
    set_entry(paths["one_task_less"], "config.json", ["tasks"], [TASKS[0]])
    paths["latents of other tasks"] = shutil.copytree(paths["latents"], root / "other")
    set_entry(paths["latents of other tasks"], str(RECORD_PATH), ["tasks"], [*reversed(TASKS)])
    return paths


@pytest.mark.parametrize(
    ("data", "command", "names"), CASES, ids=[f"{data or 'eval'}-{i}" for i, (data, _, _) in enumerate(CASES)]
)
def test_is_refused(
    data: str,
    command: str,
    names: tuple[str, ...],
    datasets: dict[str, LeRobotDataset],
    paths: dict[str, Path],
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    monkeypatch.setattr(
        MetaworldMTEnvConfig, "create_envs", lambda *_, **__: pytest.fail("environments were built")
    )
    root = Path(datasets[data].root) if data in datasets else paths.get(data, tmp_path)
    cache = root.with_name(f"{root.name}.cache")
    before = set(cache.rglob("*"))
    flags = f"--dataset.repo_id=test/{root.name} --dataset.root={root}"
    line = last_line(command.format(data=flags, out=tmp_path / "out", **paths))
    assert [name for name in names if name.lower() not in line.lower()] == [], line
    assert set(cache.rglob("*")) == before, "images were decoded first"
    assert not (tmp_path / "out" / "checkpoints").exists()


def test_a_card_cannot_show_a_dataset_that_the_world_model_does_not_read(
    paths: dict[str, Path], datasets: dict[str, LeRobotDataset], tmp_path: Path
) -> None:
    folder = shutil.copytree(paths["wm_rssm"], tmp_path / "checkpoint")
    policy = PreTrainedConfig.from_pretrained(folder)
    TrainPipelineConfig(DatasetConfig("test/demos"), policy=policy).save_pretrained(folder)
    source = SourceConfig("test/cameras", str(datasets["cameras"].root))
    with pytest.raises(ValueError, match=r"observation\.image; test/cameras has"):
        publish(PublishConfig(CheckpointConfig(str(folder)), "user/wm", dataset=source))


def test_the_order_of_tasks_is_the_checkpoints(
    paths: dict[str, Path],
    datasets: dict[str, LeRobotDataset],
    tmp_path: Path,
    lerobot_wm_command: Callable[..., None],
) -> None:
    demos = datasets["demos"]
    root = shutil.copytree(demos.root, tmp_path / "demos")
    swapped = LeRobotDataset(demos.repo_id, root=root)
    swapped.meta.tasks.index = swapped.meta.tasks.index[::-1]
    policy = type(load(paths["e2e_bc"], "e2e_bc")).from_pretrained(paths["e2e_bc"], dataset_meta=swapped.meta)
    assert policy.config.tasks == list(TASKS) == list(reversed(swapped.meta.tasks.index))


def test_latents_of_a_changed_dataset_are_made_anew(
    paths: dict[str, Path],
    datasets: dict[str, LeRobotDataset],
    tmp_path: Path,
    lerobot_wm_command: Callable[..., None],
) -> None:
    root = shutil.copytree(datasets["demos"].root, tmp_path / "demos")
    for _ in range(2):
        lerobot_wm_command(
            (NEW_BC % "wm_rssm").format(
                data=f"--dataset.repo_id=test/demos --dataset.root={root}", out=tmp_path / "out", **paths
            )
        )
        shutil.rmtree(tmp_path / "out")
        info = json.loads((root / "meta" / "info.json").read_text())  # another revision: any byte of it
        (root / "meta" / "info.json").write_text(json.dumps(info, indent=1))
    assert len(list((tmp_path / "demos.cache").glob("latents-*"))) == 2
