"""A small dataset of several files and cameras, to be broken."""

import shutil
from collections.abc import Iterator
from pathlib import Path

import numpy as np
import pytest
from lerobot.datasets.lerobot_dataset import LeRobotDataset

from tests.extended.faults.killing import WatchedCommands
from tests.extended.faults.running import Commands, Inputs, make_inputs
from tests.recording import camera, vector

FPS = 10
LENGTHS = (12, 9, 15, 10)
WIDE, SQUARE = "observation.images.wide", "observation.images.square"
FEATURES = {
    WIDE: camera(32, 48, "video"),
    SQUARE: camera(32, 32, "video"),
    "observation.state": vector(3),
    "action": vector(2),
    "next.reward": vector(1),
    "next.done": vector(1, "bool"),
}


def write_dataset(
    root: Path, lengths: tuple[int, ...] = LENGTHS, tasks: tuple[str, ...] = ("Lift", "Push")
) -> Path:
    """A dataset with a data file and a video of each camera for every episode."""
    dataset = LeRobotDataset.create("test/faults", FPS, FEATURES, root=root)
    dataset.meta.update_chunk_settings(data_files_size_in_mb=1e-6, video_files_size_in_mb=1e-6)
    rng = np.random.default_rng(0)
    for episode, length in enumerate(lengths):
        for t in range(length):
            images = {
                key: np.full(FEATURES[key]["shape"], 10 * episode + t, np.uint8) for key in (WIDE, SQUARE)
            }
            numbers = {
                key: rng.random(size, dtype=np.float32)
                for key, size in (("observation.state", 3), ("action", 2))
            }
            labels = {"next.reward": np.float32([t == length - 1]), "next.done": np.array([t == length - 1])}
            dataset.add_frame({**images, **numbers, **labels, "task": tasks[episode % len(tasks)]})
        dataset.save_episode()
    dataset.finalize()
    return root


@pytest.fixture(scope="session")
def whole_dataset(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A dataset without a fault; not to be changed."""
    return write_dataset(tmp_path_factory.mktemp("whole") / "dataset")


@pytest.fixture
def dataset(whole_dataset: Path, tmp_path: Path) -> Path:
    """A copy of it, to be broken."""
    return shutil.copytree(whole_dataset, tmp_path / "dataset")


@pytest.fixture(scope="session")
def processes(tmp_path_factory: pytest.TempPathFactory) -> Iterator[Commands]:
    """Commands in processes of their own."""
    commands = Commands(tmp_path_factory.mktemp("printed"))
    yield commands
    commands.close()


@pytest.fixture(scope="module")
def commands(tmp_path_factory: pytest.TempPathFactory) -> Iterator[WatchedCommands]:
    """Commands in processes of their own, whose writing is watched."""
    commands = WatchedCommands(tmp_path_factory.mktemp("notes"))
    yield commands
    commands.close()


@pytest.fixture(scope="session")
def inputs(processes: Commands, tmp_path_factory: pytest.TempPathFactory) -> Inputs:
    """What commands read; not to be changed."""
    return make_inputs(processes, tmp_path_factory.mktemp("inputs"))
