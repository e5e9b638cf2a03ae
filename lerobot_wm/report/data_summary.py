"""What a dataset holds: its tasks and how each begins, its sizes, and how it was collected where it says so."""

import io
import json
from dataclasses import dataclass
from pathlib import Path
from statistics import median
from typing import Any

from lerobot.datasets.dataset_metadata import LeRobotDatasetMetadata
from lerobot.datasets.lerobot_dataset import LeRobotDataset
from PIL import Image
from torch import Tensor

from lerobot_wm.constants import ACTION, OBS_STATE
from lerobot_wm.data.cache import frame_shape
from lerobot_wm.data.options import SourceConfig
from lerobot_wm.data.schema import COLLECTION_RECORD
from lerobot_wm.inspect.episodes import episodes_by_task
from lerobot_wm.inspect.html import WEBP, data_uri
from lerobot_wm.policies.common.rewards import reward_columns

PICTURE_SIZE = 256  # pixels that a picture is at most wide and high


@dataclass(frozen=True)
class TaskSummary:
    """One task of a dataset.

    `name` and `expert` are Meta-World's names of task and scripted expert, empty where they are not recorded.
    `lengths` are the shortest, median and longest episode in frames; `pictures` data URIs of the first frame of its
    first episode, one for each camera.
    """

    task: str
    name: str
    expert: str
    n_episodes: int
    n_frames: int
    lengths: tuple[int, float, int]
    pictures: list[str]


@dataclass(frozen=True)
class DataSummary:
    """A dataset; `facts` are its sizes and how it was collected, by name."""

    repo_id: str
    facts: dict[str, str]
    tasks: list[TaskSummary]


def summarise_data(meta: LeRobotDatasetMetadata, source: SourceConfig) -> DataSummary:
    """Summarise a dataset from its metadata and the first frame of each task.

    Args:
        meta: The dataset's.
        source: Where it is.
    """
    path = Path(meta.root) / COLLECTION_RECORD
    record = json.loads(path.read_text()) if path.is_file() else None
    by_task = episodes_by_task(meta)
    firsts = {task: episodes[0] for task, episodes in by_task.items()}
    pictures = _first_frames(meta, source, sorted(firsts.values()))
    all_lengths = meta.episodes["length"][:]
    tasks = []
    for task, episodes in by_task.items():
        lengths = [all_lengths[episode] for episode in episodes]
        name = record["episodes"][firsts[task]]["task"] if record else ""
        tasks.append(
            TaskSummary(
                task=task,
                name=name,
                expert=record["experts"][name] if record else "",
                n_episodes=len(lengths),
                n_frames=sum(lengths),
                lengths=(min(lengths), median(lengths), max(lengths)),
                pictures=pictures[firsts[task]],
            )
        )
    return DataSummary(meta.repo_id, _facts(meta) | (_collection(record["config"]) if record else {}), tasks)


def _facts(meta: LeRobotDatasetMetadata) -> dict[str, str]:
    """Sizes of a dataset by name, in words."""
    lengths = meta.episodes["length"][:]
    minutes = meta.total_frames / meta.fps / 60
    facts = {
        "episodes": f"{meta.total_episodes:,}, of {min(lengths)} to {max(lengths)} frames (median {median(lengths):g})",
        "frames": f"{meta.total_frames:,}, {minutes:.1f} minutes at {meta.fps} frames per second",
    }
    for key in meta.camera_keys:
        height, width, _ = frame_shape(meta.features[key])
        facts[f"camera {key}"] = f"{height} × {width} pixels"
    for name, key in (("proprioception", OBS_STATE), ("action", ACTION)):
        if key in meta.features:
            [size] = meta.features[key]["shape"]
            facts[name] = f"{size} numbers per frame"
    facts["reward columns"] = ", ".join(reward_columns(meta)) or "none"
    return facts


def _collection(config: dict[str, Any]) -> dict[str, str]:
    """How `lerobot-wm collect` made a dataset, in words."""
    numbers = ", ".join(map(str, config["variations"]))
    return {
        "collected by": f"Meta-World's scripted experts, Gaussian noise of {config['noise']:g} added to each action",
        "variations": f"{len(config['variations'])} of set {config['variation_set']} (positions of objects): {numbers}",
        "kept": f"successful episodes, with up to {config['steps_after_success']} frames after their first success",
    }


def _first_frames(
    meta: LeRobotDatasetMetadata, source: SourceConfig, episodes: list[int]
) -> dict[int, list[str]]:
    """The first frame of some episodes, in ascending order, as data URIs, one for each camera."""
    if not meta.camera_keys:
        return {episode: [] for episode in episodes}
    dataset = LeRobotDataset(source.repo_id, root=source.root, revision=source.revision, episodes=episodes)
    all_lengths, start, pictures = meta.episodes["length"][:], 0, {}
    for episode in episodes:
        frame = dataset[start]
        pictures[episode] = [_picture(frame[key]) for key in meta.camera_keys]
        start += all_lengths[episode]
    return pictures


def _picture(image: Tensor) -> str:
    """An image (C, H, W) in [0, 1] as a data URI, made smaller where it is large."""
    pixels = (255 * image).round().byte().movedim(0, -1)  # (H, W, C)
    picture = Image.fromarray(pixels.squeeze(-1).numpy())  # grey ones have no axis of channels
    picture.thumbnail((PICTURE_SIZE, PICTURE_SIZE))
    buffer = io.BytesIO()
    picture.save(buffer, "WEBP", quality=90)
    return data_uri(buffer.getvalue(), WEBP)
