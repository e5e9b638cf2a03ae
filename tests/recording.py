"""Datasets as others record them, written frame by frame with LeRobot."""

from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any

import numpy as np
from lerobot.datasets.lerobot_dataset import LeRobotDataset

from tests.flags import TRAIN_FLAGS

FRONT, WRIST = "observation.images.front", "observation.images.wrist"
FRAME_SHAPES = {FRONT: (96, 128, 3), WRIST: (48, 48, 3)}


def camera(height: int, width: int, dtype: str = "image") -> dict[str, Any]:
    """The description of an RGB camera; dtype is image (PNG) or video."""
    return {"dtype": dtype, "shape": (height, width, 3), "names": ["height", "width", "channels"]}


def vector(size: int, dtype: str = "float32") -> dict[str, Any]:
    """The description of a column of numbers."""
    return {"dtype": dtype, "shape": (size,), "names": None}


def record(
    root: Path,
    features: dict[str, dict[str, Any]],
    episodes: Sequence[tuple[str, int]],
    labels: Callable[[int, int], dict[str, Any]] = lambda t, length: {},
    *,
    fps: int = 10,
) -> LeRobotDataset:
    """Write a dataset of blocks of colour that move, and of random numbers.

    Args:
        root: Its folder.
        features: Its cameras and columns.
        episodes: Task string and number of frames of each.
        labels: Values of further columns, such as rewards, at frame t of an episode of some length.
        fps: Frames per second.
    """
    videos = any(feature["dtype"] == "video" for feature in features.values())
    dataset = LeRobotDataset.create("test/recorded", fps, features, root=root, use_videos=videos)
    rng = np.random.default_rng(0)
    for task, length in episodes:
        colours = rng.integers(0, 256, (4, 4, 3), dtype=np.uint8)
        for t in range(length):
            frame: dict[str, Any] = {"task": task, **labels(t, length)}
            for key, feature in features.items():
                if key in frame:
                    continue
                if feature["dtype"] in ("image", "video"):
                    height, width, _ = feature["shape"]
                    blocks = np.repeat(np.repeat(colours, height // 4, 0), width // 4, 1)
                    frame[key] = np.roll(blocks, 3 * t, axis=1)
                else:
                    frame[key] = rng.standard_normal(feature["shape"]).astype(feature["dtype"])
            dataset.add_frame(frame)
        dataset.save_episode()
    dataset.finalize()
    return LeRobotDataset("test/recorded", root=root)


def train_flags(dataset: LeRobotDataset) -> str:
    """Flags that train on a dataset recorded here."""
    return f"{TRAIN_FLAGS} --dataset.repo_id=test/recorded --dataset.root={dataset.root}"


def record_stranger(
    root: Path, dtype: str = "image", lengths: Sequence[int] = (10, 40, 14)
) -> LeRobotDataset:
    """Two cameras of different sizes, 9-d state, 7-d action, no reward, three tasks, an episode of each length."""
    features = {
        **{key: camera(*shape[:2], dtype) for key, shape in FRAME_SHAPES.items()},
        "observation.state": vector(9),
        "action": vector(7),
    }
    tasks = ("Pick up the cup", "Open the lid", "Wave")
    return record(root, features, [(tasks[i % 3], length) for i, length in enumerate(lengths)])
