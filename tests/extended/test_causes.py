"""Problems that users of LeRobot, Meta-World and world models have reported elsewhere."""

import getpass
import json
import pwd
import shlex
import shutil
import subprocess
import sys
from collections.abc import Callable
from pathlib import Path

import datasets
import httpx
import numpy as np
import pandas as pd
import pytest
import wandb
from lerobot.configs.default import DatasetConfig, WandBConfig
from lerobot.configs.train import TRAIN_CONFIG_NAME, TrainPipelineConfig
from lerobot.datasets.lerobot_dataset import LeRobotDataset
from lerobot.policies.factory import get_policy_class, make_policy_config

from lerobot_wm.cli import expand_home
from lerobot_wm.collect.command import CollectConfig, collect
from lerobot_wm.commands.doctor import check_folder
from lerobot_wm.data.cache import CACHE_VARIABLE, cache_root
from lerobot_wm.data.check import DatasetError, read_file
from lerobot_wm.data.source import open_dataset
from lerobot_wm.encode.dataset import _remove_cameras_from_episodes
from lerobot_wm.errors import disk_problem, exit_with_one_line
from lerobot_wm.policies.common.tasks import only_episodes, tasks_to_learn
from lerobot_wm.system import name_user, opengl_fix
from lerobot_wm.train.flags import check_episodes, check_flags, check_login, write_beside_checkpoint
from lerobot_wm.train.resume import settings_in
from tests.recording import FRONT, camera, record, train_flags, vector

TASKS = ("Reach", "Push", "Wave")
CHECKPOINT = Path("checkpoints", "last", "pretrained_model")


@pytest.fixture(scope="module")
def recorded(tmp_path_factory: pytest.TempPathFactory) -> LeRobotDataset:
    """Three tasks of two episodes each."""
    features = {FRONT: camera(32, 32, "video"), "observation.state": vector(3), "action": vector(2)}
    episodes = [(TASKS[i % 3], 6) for i in range(6)]
    return record(tmp_path_factory.mktemp("reports") / "dataset", features, episodes)


@pytest.fixture
def settings(tmp_path: Path) -> TrainPipelineConfig:
    """Those of a run, with its checkpoint."""
    policy = make_policy_config("e2e_bc", device="cpu", push_to_hub=False)
    cfg = TrainPipelineConfig(dataset=DatasetConfig("a/b"), policy=policy, output_dir=tmp_path / "run")
    cfg.optimizer = policy.get_optimizer_preset()
    folder = tmp_path / "run" / CHECKPOINT
    folder.mkdir(parents=True)
    cfg._save_pretrained(folder)
    cfg.checkpoint_path = folder.parent
    return cfg


@pytest.fixture
def unwritable(tmp_path: Path) -> Path:
    """A folder that not even root can make: a file is in its place."""
    (tmp_path / "file").write_text("")
    return tmp_path / "file" / "folder"


@pytest.mark.parametrize("flag", ["optimizer.lr", "scheduler.type"])
def test_an_optimizer_that_the_policy_chooses_is_not_set_beside_it(
    flag: str, settings: TrainPipelineConfig
) -> None:
    with pytest.raises(ValueError, match=rf"--{flag} .*--use_policy_training_preset=false"):
        check_flags(settings, ["policy.lr", flag])
    settings.use_policy_training_preset = False
    check_flags(settings, [flag])
    with pytest.raises(ValueError, match=r"--policy\.lr .*--optimizer\.lr"):
        check_flags(settings, ["policy.lr"])


def test_a_resumed_run_keeps_its_optimizer(settings: TrainPipelineConfig) -> None:
    settings.resume = True
    # The command of the first run, repeated.
    check_flags(settings, ["policy.lr", "optimizer.lr", "steps"])
    settings.optimizer.grad_clip_norm = 1.0
    check_flags(settings, ["optimizer.grad_clip_norm"])
    settings.policy.lr = 1e-5
    settings.optimizer.lr = 1e-5
    for flag in ("policy.lr", "optimizer.lr"):
        with pytest.raises(ValueError, match=rf"--{flag} .*--policy.path="):
            check_flags(settings, [flag])


def test_a_moved_run_is_resumed_where_it_is(settings: TrainPipelineConfig, tmp_path: Path) -> None:
    settings.resume = True
    write_beside_checkpoint(settings, [])
    assert settings.output_dir == tmp_path / "run"
    (tmp_path / "run").rename(tmp_path / "moved")
    settings.checkpoint_path = tmp_path / "moved" / "checkpoints" / "last"
    write_beside_checkpoint(settings, ["output_dir"])
    assert settings.output_dir == tmp_path / "run"
    write_beside_checkpoint(settings, [])
    assert settings.output_dir == tmp_path / "moved"


def test_any_folder_of_a_run_names_its_settings(settings: TrainPipelineConfig, tmp_path: Path) -> None:
    run = tmp_path / "run"
    expected = run / CHECKPOINT / TRAIN_CONFIG_NAME
    for folder in (run, run / "checkpoints", run / "checkpoints" / "last", run / CHECKPOINT, expected):
        assert settings_in(folder) == expected
    assert expected.is_file()
    assert settings_in(Path("user/run")) == Path("user/run")


@pytest.mark.parametrize(("name", "value"), [("batch_size", 0), ("steps", 0), ("num_workers", -1)])
def test_numbers_out_of_range(name: str, value: int, settings: TrainPipelineConfig) -> None:
    setattr(settings, name, value)
    with pytest.raises(ValueError, match=f"--{name}={value}"):
        check_flags(settings, [])


def test_settings_that_cannot_work_are_found_before_the_dataset_is_encoded(
    settings: TrainPipelineConfig, monkeypatch: pytest.MonkeyPatch
) -> None:
    settings.dataset.image_transforms.enable = True
    with pytest.raises(ValueError, match="image_transforms"):
        check_flags(settings, [])
    settings.dataset.image_transforms.enable = False
    settings.policy.compile_model = True
    monkeypatch.setenv("PATH", "")
    monkeypatch.delenv("CXX", raising=False)
    with pytest.raises(ValueError, match="CXX"):
        check_flags(settings, [])


def test_no_login_for_wandb(
    settings: TrainPipelineConfig, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setenv("NETRC", str(tmp_path / "netrc"))
    monkeypatch.delenv("WANDB_API_KEY", raising=False)
    settings.wandb = WandBConfig(enable=True, mode="offline")
    check_login(settings)
    settings.wandb.mode = None
    wandb.teardown()
    with pytest.raises(ValueError, match="wandb login"):
        check_login(settings)


def test_episodes_that_are_not_there(settings: TrainPipelineConfig, recorded: LeRobotDataset) -> None:
    settings.dataset.episodes = []
    with pytest.raises(ValueError, match=r"--dataset\.episodes"):
        check_flags(settings, [])
    settings.dataset.episodes = [0, 6]
    with pytest.raises(ValueError, match=r"6.* 0 to 5"):
        check_episodes(settings, recorded.meta)


def test_a_cache_that_cannot_be_written_is_no_damaged_dataset(
    recorded: LeRobotDataset, unwritable: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(datasets.config, "HF_DATASETS_CACHE", str(unwritable))
    monkeypatch.setenv("HF_DATASETS_CACHE", str(unwritable))
    shutil.copytree(recorded.root, tmp_path / "copy")
    with pytest.raises(OSError, match=str(unwritable)) as error:
        open_dataset("a/b", tmp_path / "copy")
    assert not isinstance(error.value, DatasetError)
    assert "HF_DATASETS_CACHE" in str(disk_problem(error.value))
    with pytest.raises(SystemExit, match="HF_DATASETS_CACHE"), exit_with_one_line("command"):
        LeRobotDataset("a/b", root=tmp_path / "copy")  # which then asks the Hub


def test_a_file_that_is_damaged_is_called_so(tmp_path: Path) -> None:
    (tmp_path / "table.parquet").write_text("no table")
    with pytest.raises(DatasetError, match=r"table\.parquet"):
        read_file(tmp_path / "table.parquet", pd.read_parquet)


@pytest.mark.parametrize(("method", "is_push"), [("GET", False), ("HEAD", False), ("POST", True)])
def test_a_lost_connection_is_a_push_only_where_something_is_written(method: str, is_push: bool) -> None:
    request = httpx.Request(method, "https://hub.example/api/models/a/b")
    with pytest.raises(SystemExit) as end, exit_with_one_line("command"):
        raise httpx.ConnectError("refused", request=request)
    assert "hub.example" in str(end.value)
    assert ("push" in str(end.value)) == is_push


@pytest.mark.parametrize(
    ("reason", "fix"),
    [
        ("The MUJOCO_EGL_DEVICE_ID environment variable must be an integer", "MUJOCO_EGL_DEVICE_ID"),
        ("invalid literal for int() with base 10: 'abc'", "MUJOCO_EGL_DEVICE_ID"),
        ("invalid value for environment variable MUJOCO_GL: bogus", "unset MUJOCO_GL"),
        ("'NoneType' object has no attribute 'eglQueryString'", "libegl1"),
    ],
)
def test_advice_for_opengl_follows_its_reason(reason: str, fix: str) -> None:
    assert fix in opengl_fix(reason)


def test_the_home_folder_after_an_equals_sign(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("HOME", "/home/me")
    for given, expected in {
        "--root=~/x": "--root=/home/me/x",
        "--policy.path=~": "--policy.path=/home/me",
        "--compare=[~/x,~/y]": "--compare=[/home/me/x,/home/me/y]",
        "--train_logs=a,~/y": "--train_logs=a,/home/me/y",
        "--root=a/~b": "--root=a/~b",
        "--task=~ 5 cm": "--task=~ 5 cm",
        "--resume": "--resume",
    }.items():
        assert expand_home(given) == expected


def test_two_datasets_of_one_name_do_not_share_a_cache(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setenv(CACHE_VARIABLE, str(tmp_path / "cache"))
    first, second = (cache_root(tmp_path / name / "dataset") for name in ("a", "b"))
    assert first != second
    assert cache_root(tmp_path / "b" / ".." / "a" / "dataset") == first


def test_two_tasks_of_one_sentence_are_not_learned_as_one(tmp_path: Path) -> None:
    """In lerobot/metaworld_mt50, push-v3 and push-back-v3 share their sentence and differ in `task_id`."""
    features = {"observation.state": vector(3), "action": vector(2), "task_id": vector(1, "int16")}
    episodes = [("Push", 6), ("Reach", 5), ("Push", 7), ("Push", 7)]
    dataset = record(
        tmp_path / "dataset",
        features,
        episodes,
        lambda t, length: {"task_id": np.array([length], dtype=np.int16)},
    )
    with pytest.raises(
        ValueError, match="tasks 6 and 7 of the column task_id share the sentence 'Push'"
    ) as error:
        tasks_to_learn(dataset.meta)
    with only_episodes([0, 1]):
        assert tasks_to_learn(dataset.meta) == ["Push", "Reach"]
    command = str(error.value).partition("`")[2].partition("`")[0].replace("ANOTHER SENTENCE", "Push back")
    program, *flags = shlex.split(command)
    subprocess.run([Path(sys.executable).parent / program, *flags], check=True)
    dataset = LeRobotDataset(dataset.repo_id, root=dataset.root)
    assert sorted(tasks_to_learn(dataset.meta)) == ["Push", "Push back", "Reach"]


def test_a_policy_knows_the_tasks_that_it_was_trained_on(recorded: LeRobotDataset) -> None:
    config = make_policy_config("e2e_bc", device="cpu", encoder_image_size=(32, 32))
    config.input_features, config.output_features = {}, {}
    with only_episodes([1, 4]):
        config.fill_from_dataset(recorded.meta)
    # The networks have the same size, whichever episodes are chosen.
    assert config.tasks == list(TASKS)
    assert config.known_tasks == ["Push"]
    config.fill_from_dataset(recorded.meta)
    assert config.known_tasks == list(TASKS)


def test_a_table_of_episodes_without_cameras(recorded: LeRobotDataset, tmp_path: Path) -> None:
    shutil.copytree(Path(recorded.root) / "meta", tmp_path / "meta")
    [path] = (tmp_path / "meta" / "episodes").glob("*/*.parquet")
    before = pd.read_parquet(path)
    _remove_cameras_from_episodes(tmp_path, [FRONT])
    after = pd.read_parquet(path)
    removed = [name for name in before if FRONT in name]
    assert any(name.startswith("videos/") for name in removed)
    pd.testing.assert_frame_equal(after, before.drop(columns=removed))


def test_collect_looks_first_at_the_cache_that_merging_needs(
    unwritable: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setenv("HF_DATASETS_CACHE", str(unwritable))
    with pytest.raises(OSError, match=str(unwritable.parent)):
        collect(CollectConfig(repo_id="a/b", root=tmp_path / "demos"))
    assert not (tmp_path / "demos.shards").exists()


def test_doctor_finds_a_folder_that_cannot_be_written(unwritable: Path) -> None:
    check = check_folder("disk", unwritable)
    assert check.is_broken
    assert str(unwritable.parent) in check.fix


def test_a_user_id_without_a_name(monkeypatch: pytest.MonkeyPatch) -> None:
    def no_name(uid: int) -> None:
        raise KeyError(f"getpwuid(): uid not found: {uid}")

    monkeypatch.setattr(pwd, "getpwuid", no_name)
    for variable in ("LOGNAME", "USER", "LNAME", "USERNAME"):
        # Set first, so that its value is restored afterwards.
        monkeypatch.setenv(variable, "")
        monkeypatch.delenv(variable)
    name_user()
    assert getpass.getuser()


@pytest.fixture(scope="module")
def run(
    recorded: LeRobotDataset,
    tmp_path_factory: pytest.TempPathFactory,
    lerobot_wm_command: Callable[..., None],
) -> Path:
    """A run of a policy from pixels on the episodes of two tasks, of which one each is held out."""
    folder = tmp_path_factory.mktemp("run") / "run"
    lerobot_wm_command(
        "train --policy.type=e2e_bc --policy.encoder_image_size=[32,32] --steps=2 --save_freq=1 --batch_size=4",
        "--dataset.episodes=[0,1,3,4] --dataset.eval_split=0.5 --eval_steps=1 --log_freq=1",
        f"{train_flags(recorded)} --output_dir={folder}",
    )
    return folder


def test_the_held_out_loss_is_in_the_log(run: Path) -> None:
    lines = [json.loads(line) for line in (run / "train_log.jsonl").read_text().splitlines()]
    assert [line["step"] for line in lines if "eval_loss" in line] == [1, 2]
    assert [line["step"] for line in lines if "loss" in line] == [1, 2]


def test_the_tasks_of_the_chosen_episodes_are_in_the_checkpoint(run: Path) -> None:
    policy = get_policy_class("e2e_bc").from_pretrained(run / CHECKPOINT)
    assert policy.config.known_tasks == ["Reach", "Push"]
    with pytest.raises(ValueError, match="Wave"):
        policy.one_hot_tasks({"task": ["Wave"]}, 1)
    assert policy.one_hot_tasks({"task": ["Push"]}, 1).tolist() == [[0, 1, 0]]


def test_a_run_that_was_moved_is_resumed_by_its_folder(
    run: Path, tmp_path: Path, lerobot_wm_command: Callable[..., None]
) -> None:
    moved = tmp_path / "moved"
    shutil.copytree(run, moved, symlinks=True)
    lerobot_wm_command(f"train --config_path={moved} --resume=true --steps=3")
    assert (moved / "checkpoints" / "last").resolve().name == "000003"
    assert (run / "checkpoints" / "last").resolve().name == "000002"
