"""What the page says of training: the dataset, its tasks and how each begins, and the curves of runs."""

import io
import json
import os
from dataclasses import dataclass
from pathlib import Path
from statistics import median
from typing import Any

from lerobot.datasets.dataset_metadata import LeRobotDatasetMetadata
from lerobot.datasets.lerobot_dataset import LeRobotDataset
from matplotlib import colormaps
from matplotlib.figure import Figure
from PIL import Image
from torch import Tensor

from lerobot_wm.constants import ACTION, OBS_STATE, TRAIN_LOG_NAME
from lerobot_wm.data.cache import frame_shape
from lerobot_wm.data.schema import COLLECTION_RECORD
from lerobot_wm.data.source import SourceConfig
from lerobot_wm.inspect.episodes import episodes_by_task
from lerobot_wm.inspect.pictures import WEBP, data_uri, log_scale, shorten, tidy
from lerobot_wm.policies.common.iql import reward_columns

# Of the first frames shown, in pixels.
MAX_PICTURE_SIZE = 256


@dataclass(frozen=True)
class TaskSummary:
    """One task of a dataset.

    Attributes:
        task: The task's description.
        name, expert: Meta-World's names of task and scripted expert; empty where they are not recorded.
        n_episodes, n_frames: How many.
        lengths: Shortest, median and longest episode in frames.
        pictures: Data URIs of the first frame of the first episode, one for each camera.
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
    """A dataset: `facts` names its sizes and how it was collected."""

    repo_id: str
    facts: dict[str, str]
    tasks: list[TaskSummary]


def summarise_data(meta: LeRobotDatasetMetadata, source: SourceConfig) -> DataSummary:
    """Summarise a dataset from its metadata and the first frame of each task.

    Args:
        meta: The dataset's metadata.
        source: Where the dataset is.
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
    """Sizes of a dataset, in words."""
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
        "collected by": f"Meta-World's scripted experts, with Gaussian noise of {config['noise']:g} on each action",
        "variations": f"{len(config['variations'])} object positions of set {config['variation_set']}: {numbers}",
        "kept": f"successful episodes, until {config['steps_after_success']} frames after their first success",
    }


def _first_frames(
    meta: LeRobotDatasetMetadata, source: SourceConfig, episodes: list[int]
) -> dict[int, list[str]]:
    """The first frame of some episodes, given in ascending order, as data URIs, one for each camera."""
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
    """An image (C, H, W) in [0, 1] as a data URI, reduced to MAX_PICTURE_SIZE."""
    pixels = (255 * image).round().byte().movedim(0, -1)  # (H, W, C)
    # Pillow's grey images have no axis of channels.
    picture = Image.fromarray(pixels.squeeze(-1).numpy())
    picture.thumbnail((MAX_PICTURE_SIZE, MAX_PICTURE_SIZE))
    buffer = io.BytesIO()
    picture.save(buffer, "WEBP", quality=90)
    return data_uri(buffer.getvalue(), WEBP)


# LeRobot's counters, which say nothing about learning; nor do its timings, whose names end in _s.
BOOKKEEPING = {"steps", "samples", "episodes", "epochs", "gpu_mem_gb"}
# One run's values by name: (step, value) each.
Curves = dict[str, list[tuple[int, float]]]
COLOURS = colormaps["tab20"].colors  # type: ignore[attr-defined]  # a ListedColormap
LEGEND_COLUMNS = 2


def read_logs(runs: list[Path]) -> dict[str, Curves]:
    """Read the curves of runs by name: the run's folder, relative to the one that holds them all.

    Raises:
        FileNotFoundError: A folder holds no log.
    """
    if not runs:
        return {}
    common = os.path.commonpath([run.absolute().parent for run in runs])
    return {os.path.relpath(run, common): read_curves(run) for run in runs}


def read_curves(run: Path) -> Curves:
    """Read the losses and other measures that a run logged.

    Raises:
        FileNotFoundError: The folder holds no log.
    """
    path = run / TRAIN_LOG_NAME
    if not path.exists():
        raise FileNotFoundError(
            f"{path} is missing: --train_logs takes output folders of `lerobot-wm train`."
        )
    curves: Curves = {}
    for line in path.read_text().splitlines():
        entry = json.loads(line)
        step = entry.pop("step")
        for name in entry.keys() - BOOKKEEPING:
            if not name.endswith("_s"):
                curves.setdefault(name, []).append((step, entry[name]))
    # A resumed run logs some steps again: the last value counts.
    return {name: sorted(dict(points).items()) for name, points in curves.items()}


def curve_figures(runs: dict[str, Curves]) -> list[Figure]:
    """One figure per logged name, with one line per run.

    Runs whose folders have the same name (the seeds of an arm) share a colour and an entry in the legend.
    """
    return [_figure(name, runs) for name in sorted({name for curves in runs.values() for name in curves})]


def _figure(name: str, runs: dict[str, Curves]) -> Figure:
    # Folder name -> the points of its runs.
    lines: dict[str, list[list[tuple[int, float]]]] = {}
    for run, curves in runs.items():
        if name in curves:
            lines.setdefault(Path(run).name, []).append(curves[name])
    legend_rows = -(-len(lines) // LEGEND_COLUMNS) if len(runs) > 1 else 0
    figure = Figure(figsize=(3.6, 2.4 + 0.15 * legend_rows), layout="constrained")
    axes = figure.subplots()
    for index, (label, of_label) in enumerate(lines.items()):
        # tab20 holds ten strong colours, each followed by its pale partner.
        colour = COLOURS[(2 * index + index // 10) % 20]
        for number, points in enumerate(of_label):
            line_label = None if number else shorten(label)
            axes.plot(*zip(*points, strict=True), color=colour, linewidth=1.2, label=line_label)
    lowest, highest = axes.dataLim.ymin, axes.dataLim.ymax
    # Otherwise a loss's first steps would hide the rest.
    if lowest > 0 and highest > 10 * lowest:
        log_scale(axes)
    axes.set_xlabel("step", fontsize=8)
    tidy(axes, name)
    if len(runs) > 1:
        figure.legend(loc="outside lower center", ncols=LEGEND_COLUMNS, fontsize=7, frameon=False)
    return figure
