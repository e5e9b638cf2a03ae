"""Broken checkpoints are refused by every way in, in one line that names the file, before any work."""

import pickle
import re
import shutil
from collections.abc import Callable
from functools import partial
from pathlib import Path

import pytest
from lerobot.datasets.lerobot_dataset import LeRobotDataset
from lerobot.utils.constants import TRAINING_STEP

from lerobot_wm.encode.dataset import encode
from lerobot_wm.envs.configuration import MetaworldMTEnvConfig
from tests.extended.faults.breakage import Fault, cut, remove
from tests.extended.faults.checkpoints import (
    CONFIG,
    CONFIG_FAULTS,
    PROCESSOR_FAULTS,
    WEIGHT_FAULTS,
    WEIGHTS,
    Canary,
    broken_copy,
    last_line,
    load,
    make_checkpoint,
    plant_pickles,
    record_demos,
    set_type,
)
from tests.flags import DATASET_FLAGS, TRAIN_FLAGS

TYPES = ("wm_rssm", "wm_bc", "wm_iql", "e2e_bc", "e2e_iql", "frozen_backbone")
WAYS = {
    "train": "e2e_bc",
    "eval": "e2e_bc",
    "world_model_path": "wm_rssm",
    "encode": "wm_rssm",
    "dream": "wm_bc",
}
FAULTS = {**WEIGHT_FAULTS, **CONFIG_FAULTS}
# Of each kind of error one: all of them are tried in Python. `train` and `eval` read the processors too.
SOME = {
    name: FAULTS[name]
    for name in (
        "weights cut short",
        "weights missing",
        "configuration cut short",
        "a setting of a newer release",
    )
}


@pytest.fixture(scope="module")
def demos(tmp_path_factory: pytest.TempPathFactory) -> LeRobotDataset:
    return record_demos(tmp_path_factory.mktemp("demos") / "dataset")


@pytest.fixture(scope="module")
def latents(demos: LeRobotDataset, checkpoints: dict[str, Path]) -> LeRobotDataset:
    world_model = load(checkpoints["wm_rssm"], "wm_rssm")
    return encode(world_model, demos, "test/latents", Path(demos.root).with_name("latents"))


@pytest.fixture(scope="module")
def checkpoints(demos: LeRobotDataset, tmp_path_factory: pytest.TempPathFactory) -> dict[str, Path]:
    """Checkpoints of the types that need no world model, by type."""
    root = tmp_path_factory.mktemp("checkpoints")
    return {
        name: make_checkpoint(name, root / name, demos) for name in TYPES if name not in ("wm_bc", "wm_iql")
    }


@pytest.fixture(scope="module")
def all_checkpoints(
    checkpoints: dict[str, Path], latents: LeRobotDataset, tmp_path_factory: pytest.TempPathFactory
) -> dict[str, Path]:
    """A checkpoint of every type."""
    root, path = tmp_path_factory.mktemp("policies"), str(checkpoints["wm_rssm"])
    return checkpoints | {
        name: make_checkpoint(name, root / name, latents, world_model_path=path)
        for name in ("wm_bc", "wm_iql")
    }


@pytest.fixture
def no_work(monkeypatch: pytest.MonkeyPatch, demos: LeRobotDataset, tmp_path: Path) -> Callable[[], None]:
    """Call it when the command has ended: nothing was written or decoded. Environments fail as they are built."""

    def fail(*args: object, **kwargs: object) -> None:
        pytest.fail("an environment was built")

    monkeypatch.setattr(MetaworldMTEnvConfig, "create_envs", fail)
    cache = Path(demos.root).with_name("dataset.cache")
    before = set(cache.rglob("*"))

    def check() -> None:
        assert set(cache.rglob("*")) == before
        written = [path for path in (tmp_path / "out").rglob("*") if path.is_file()]
        assert not [path for path in written if path.stat().st_size], "other than an empty lock"

    return check


def command(way: str, checkpoint: Path, demos: LeRobotDataset, latents: LeRobotDataset, out: Path) -> str:
    """A way in, as a command line."""
    images = DATASET_FLAGS.format(root=demos.root)
    of_latents = f"--dataset.repo_id=test/latents --dataset.root={latents.root}"
    training = f"{TRAIN_FLAGS} --steps=1 --batch_size=2 --output_dir={out}"
    match way:
        case "train":
            return f"train --policy.path={checkpoint} {training} {images}"
        case "world_model_path":
            return f"train --policy.type=wm_bc --policy.world_model_path={checkpoint} {training} {of_latents}"
        case "encode":
            return (
                f"encode --world_model_path={checkpoint} --device=cpu {images} --output_repo_id=a/b "
                f"--output_root={out}"
            )
        case "eval":
            return (
                f"eval --policy.path={checkpoint} --policy.device=cpu --env.type=metaworld_mt --env.task=reach-v3 "
                f"--eval.n_episodes=1 --seed=0 --output_dir={out}"
            )
        case _:
            return f"dream --policy.path={checkpoint} {images} --episode=0 --output_dir={out}"


@pytest.mark.parametrize("policy_type", TYPES)
def test_python_refuses(policy_type: str, all_checkpoints: dict[str, Path], tmp_path: Path) -> None:
    load(all_checkpoints[policy_type], policy_type)
    for number, (break_it, says) in enumerate(FAULTS.values()):
        broken = broken_copy(all_checkpoints[policy_type], tmp_path / str(number), break_it)
        with pytest.raises((ValueError, FileNotFoundError)) as refusal:
            load(broken, policy_type)
        assert str(refusal.value).startswith(f"{broken}{says}")
        shutil.rmtree(broken)


@pytest.mark.parametrize("policy_type", TYPES)
def test_python_refuses_a_checkpoint_of_another_type(
    policy_type: str, all_checkpoints: dict[str, Path]
) -> None:
    for other in set(TYPES) - {policy_type}:
        with pytest.raises(ValueError, match=rf" is a {other}, not a {policy_type}: "):
            load(all_checkpoints[other], policy_type)


@pytest.mark.parametrize("way", WAYS)
def test_commands_refuse(
    way: str,
    all_checkpoints: dict[str, Path],
    demos: LeRobotDataset,
    latents: LeRobotDataset,
    tmp_path: Path,
    no_work: Callable[[], None],
) -> None:
    faults = {**SOME, **PROCESSOR_FAULTS} if way in ("train", "eval") else SOME
    for number, (name, (break_it, says)) in enumerate(faults.items()):
        broken = broken_copy(all_checkpoints[WAYS[way]], tmp_path / str(number), break_it)
        line = last_line(command(way, broken, demos, latents, tmp_path / "out"))
        assert line.split(": ", 1)[1].startswith(f"{broken}{says}"), name
        no_work()
        shutil.rmtree(broken)


@pytest.mark.parametrize("way", WAYS)
def test_a_link_that_leads_nowhere(
    way: str,
    demos: LeRobotDataset,
    latents: LeRobotDataset,
    tmp_path: Path,
    no_work: Callable[[], None],
) -> None:
    (tmp_path / "000002").mkdir()
    (tmp_path / "last").symlink_to("000004")
    line = last_line(command(way, tmp_path / "last" / "pretrained_model", demos, latents, tmp_path / "out"))
    assert f"{tmp_path / 'last'} is a link to 000004, which does not exist; {tmp_path} holds 000002. " in line
    no_work()


def test_a_world_model_needs_no_processors(all_checkpoints: dict[str, Path], tmp_path: Path) -> None:
    bare = tmp_path / "bare"
    bare.mkdir()
    for name in (CONFIG, WEIGHTS):
        shutil.copy(all_checkpoints["wm_rssm"] / name, bare)
    load(bare, "wm_rssm")


@pytest.mark.parametrize(
    ("name", "says"),
    [("wm_bc", " is not a configuration of the wm_bc"), ("act", " is not a configuration of the act")],
)
def test_a_configuration_of_another_type(
    name: str, says: str, checkpoints: dict[str, Path], demos: LeRobotDataset, tmp_path: Path
) -> None:
    broken = broken_copy(checkpoints["wm_rssm"], tmp_path / "checkpoint", partial(set_type, name=name))
    line = last_line(command("encode", broken, demos, demos, tmp_path / "out"))
    assert f"{broken / CONFIG}{says}" in line


def test_a_policy_without_a_world_model_where_one_is_needed(
    checkpoints: dict[str, Path], demos: LeRobotDataset, latents: LeRobotDataset, tmp_path: Path
) -> None:
    for way in ("world_model_path", "encode", "dream"):
        line = last_line(command(way, checkpoints["e2e_bc"], demos, latents, tmp_path / "out"))
        assert f"{checkpoints['e2e_bc']} (e2e_bc) holds no world model: give a checkpoint of wm_rssm" in line


@pytest.fixture(scope="module")
def run_folder(
    demos: LeRobotDataset, tmp_path_factory: pytest.TempPathFactory, lerobot_wm_command: Callable[..., None]
) -> Path:
    """A run of one step."""
    folder = tmp_path_factory.mktemp("run") / "run"
    lerobot_wm_command(
        f"train --policy.type=e2e_bc --policy.hidden_dims=[8] --steps=1 --batch_size=2 {TRAIN_FLAGS}",
        DATASET_FLAGS.format(root=demos.root),
        f"--output_dir={folder}",
    )
    return folder


def resume_flags(folder: Path) -> str:
    """Flags that go on with a run for one step."""
    last = folder / "checkpoints" / "last" / "pretrained_model"
    return f"train --config_path={last / 'train_config.json'} --resume=true --steps=2 --output_dir={folder}"


STEP, SETTINGS = f"training_state/{TRAINING_STEP}", "pretrained_model/train_config.json"
# What else is wrong with a run's state LeRobot tells.
RUN_FAULTS: dict[str, Fault] = {
    "step cut short": partial(cut, name=STEP),
    "step missing": partial(remove, name=STEP),
    "settings missing": partial(remove, name=SETTINGS),
    "settings cut short": partial(cut, name=SETTINGS),
    **{
        name: lambda root, break_it=break_it: break_it(root / "pretrained_model")
        for name, (break_it, _) in {**FAULTS, **PROCESSOR_FAULTS}.items()
        if name in ("weights cut short", "NaN in a weight", "configuration cut short", "statistics missing")
    },
}


@pytest.mark.parametrize("fault", RUN_FAULTS)
def test_a_broken_run_is_not_resumed(
    fault: str, run_folder: Path, tmp_path: Path, lerobot_wm_command: Callable[..., None]
) -> None:
    folder = shutil.copytree(run_folder, tmp_path / "run", symlinks=True)
    RUN_FAULTS[fault](folder / "checkpoints" / "000001")
    with pytest.raises(Exception, match=re.escape(str(folder / "checkpoints"))):
        lerobot_wm_command(resume_flags(folder))
    assert not (folder / "checkpoints" / "000002").exists()


def test_pickles_are_never_opened(
    checkpoints: dict[str, Path],
    demos: LeRobotDataset,
    run_folder: Path,
    tmp_path: Path,
    lerobot_wm_command: Callable[..., None],
) -> None:
    canary = tmp_path / "canary"
    folder = shutil.copytree(run_folder, tmp_path / "run", symlinks=True)
    for name in ("pretrained_model", "training_state"):
        plant_pickles(folder / "checkpoints" / "000001" / name, canary)
    lerobot_wm_command(resume_flags(folder))
    world_model = broken_copy(checkpoints["wm_rssm"], tmp_path / "wm", partial(plant_pickles, canary=canary))
    lerobot_wm_command(command("encode", world_model, demos, demos, tmp_path / "latents"))
    (world_model / WEIGHTS).write_bytes(pickle.dumps(Canary(canary)))
    assert "cannot be read" in last_line(command("encode", world_model, demos, demos, tmp_path / "out"))
    assert not canary.exists()
    pickle.loads((world_model / WEIGHTS).read_bytes())
    assert canary.exists(), "the canary would have told nothing"
