"""A small real dataset, world model and latent dataset, made once per test run through the public commands."""

import os
import sys
from collections.abc import Callable, Iterator
from pathlib import Path

import numpy as np
import pytest
import torch
from accelerate.state import AcceleratorState

os.environ.setdefault("HF_HUB_OFFLINE", "1")
os.environ.setdefault("WANDB_ERROR_REPORTING", "false")  # else wandb reports its own errors to its makers

from lerobot.datasets.lerobot_dataset import LeRobotDataset
from lerobot.scripts import lerobot_train

import lerobot_wm  # noqa: F401  (registers the policy and environment types)
from lerobot_wm import cli
from lerobot_wm.envs.metaworld_mt import MetaworldMTEnv
from tests.flags import DATASET_FLAGS, TRAIN_FLAGS


@pytest.fixture(scope="session", autouse=True)
def one_thread() -> None:
    torch.set_num_threads(1)


@pytest.fixture(autouse=True)
def precision_of_one_test() -> Iterator[None]:
    """Have accelerate forget the precision of a test's trainings: it keeps that of a process's first."""
    yield
    AcceleratorState._reset_state(True)


def run_command(*arguments: str) -> None:
    """Run `lerobot-wm ARGUMENTS` in this process; arguments may hold several flags separated by spaces."""
    before = sys.argv
    sys.argv = ["lerobot-wm", *" ".join(arguments).split()]
    try:
        cli.main()
    except SystemExit as end:
        raise end.__cause__ or end from None  # the error that the command's one line was made of
    finally:
        sys.argv = before
        # A process trains at one precision, and a test runs several commands.
        AcceleratorState._reset_state(True)


@pytest.fixture(scope="session")
def lerobot_wm_command() -> Callable[..., None]:
    """`lerobot-wm` as a function."""
    return run_command


@pytest.fixture
def lerobot_train_command(monkeypatch: pytest.MonkeyPatch) -> Callable[[str], None]:
    """`lerobot-train` as a function of its flags."""

    def run(flags: str) -> None:
        monkeypatch.setattr(sys, "argv", ["lerobot-train", *flags.split()])
        lerobot_train.main()

    return run


@pytest.fixture(scope="session")
def demos_root(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Four demonstrations of each of two tasks, collected from the simulator."""
    root = tmp_path_factory.mktemp("demos") / "dataset"
    run_command(
        "collect --tasks=reach-v3,window-close-v3 --episodes_per_task=4 --variations=0-9 --noise=0.3 --seed=0",
        f"--repo_id=test/demos --root={root} --num_workers=2",
    )
    return root


@pytest.fixture(scope="session")
def demos(demos_root: Path) -> LeRobotDataset:
    """The demonstrations as a LeRobotDataset."""
    return LeRobotDataset("test/demos", root=demos_root)


@pytest.fixture(scope="session")
def world_model_path(demos_root: Path, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A wm_rssm checkpoint trained for a few steps."""
    run_folder = tmp_path_factory.mktemp("world_model") / "run"
    run_command(
        "train --policy.type=wm_rssm --steps=12 --batch_size=4 --log_freq=4 --save_freq=6",
        TRAIN_FLAGS,
        DATASET_FLAGS.format(root=demos_root),
        f"--output_dir={run_folder}",
    )
    return run_folder / "checkpoints" / "last" / "pretrained_model"


@pytest.fixture(scope="session")
def latents_root(demos_root: Path, world_model_path: Path, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """The demonstrations encoded by `world_model_path`."""
    root = tmp_path_factory.mktemp("latents") / "dataset"
    run_command(
        f"encode --world_model_path={world_model_path} --device=cpu --output_repo_id=test/latents",
        DATASET_FLAGS.format(root=demos_root),
        f"--output_root={root}",
    )
    return root


@pytest.fixture(scope="session")
def policy_paths(
    latents_root: Path, world_model_path: Path, tmp_path_factory: pytest.TempPathFactory
) -> dict[str, Path]:
    """Checkpoints of wm_bc and wm_iql trained for a few steps, by policy type."""
    paths = {}
    for policy_type in ("wm_bc", "wm_iql"):
        run_folder = tmp_path_factory.mktemp(policy_type) / "run"
        run_command(
            f"train --policy.type={policy_type} --policy.world_model_path={world_model_path}",
            "--steps=20 --batch_size=32 --log_freq=10 --save_freq=10",
            TRAIN_FLAGS,
            f"--dataset.repo_id=test/latents --dataset.root={latents_root} --output_dir={run_folder}",
        )
        paths[policy_type] = run_folder / "checkpoints" / "last" / "pretrained_model"
    return paths


@pytest.fixture
def make_env() -> Iterator[Callable[..., MetaworldMTEnv]]:
    """Makes environments and closes them after the test."""
    envs: list[MetaworldMTEnv] = []

    def make(task: str, **kwargs: object) -> MetaworldMTEnv:
        envs.append(MetaworldMTEnv(task, **kwargs))
        return envs[-1]

    yield make
    for env in envs:
        env.close()


@pytest.fixture
def actions() -> np.ndarray:
    """Ten random actions, float32 (10, 4)."""
    return np.random.default_rng(0).uniform(-1.0, 1.0, (10, 4)).astype(np.float32)
