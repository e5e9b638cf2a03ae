"""Open-loop prediction: the world model sees five frames, then imagines the next ones from actions alone."""

import logging
import math
from dataclasses import dataclass

import numpy as np
import torch
from lerobot.datasets.dataset_metadata import LeRobotDatasetMetadata
from matplotlib.figure import Figure
from torch import Tensor
from tqdm import tqdm

from lerobot_wm.data.source import SourceConfig
from lerobot_wm.encode.episodes import Episode
from lerobot_wm.inspect.episodes import (
    ImaginingPolicy,
    episodes_by_task,
    filter_episodes,
    imagine,
    load_episodes,
    rssm_of,
)
from lerobot_wm.inspect.pictures import draw_pictures
from lerobot_wm.nn.images import side_by_side
from lerobot_wm.tables import Measurement, ReportTable

logger = logging.getLogger(__name__)

# Frames that the model sees.
CONTEXT = 5
# Steps ahead of the last frame seen.
HORIZONS = (1, 5, 10, 20, 45)
WINDOW = CONTEXT + HORIZONS[-1]
EPISODES_PER_TASK = 4


@dataclass(frozen=True)
class OpenLoop:
    """Predictions of one task's episodes, from their first frames on.

    Attributes:
        task: The task.
        n_episodes: How many episodes were predicted.
        truth: The first episode's images, (CONTEXT + H, C, H, W) in [0, 1], several cameras side by side.
        imagined: The images imagined after the context, (H, C, H, W).
        psnr: PSNR in dB at each horizon, from the squared error averaged over pixels, cameras and episodes.
        copy_psnr: The PSNR of repeating the last frame seen.
    """

    task: str
    n_episodes: int
    truth: np.ndarray
    imagined: np.ndarray
    psnr: list[float]
    copy_psnr: list[float]


def open_loop(policy: ImaginingPolicy, meta: LeRobotDatasetMetadata, source: SourceConfig) -> list[OpenLoop]:
    """Predict the last episodes of each task, which LeRobot's `eval_split` holds out; none where all are too short.

    Args:
        policy: Holds the world model.
        meta: A dataset that it can read, see `check_features`.
        source: Where the dataset is.
    """
    by_task = episodes_by_task(meta, min_length=WINDOW)
    if not by_task:
        logger.warning(
            "%s has no episode of %d frames, which open-loop prediction needs.", meta.repo_id, WINDOW
        )
        return []
    chosen = sorted(index for episodes in by_task.values() for index in episodes[-EPISODES_PER_TASK:])
    windows: dict[str, list[Episode]] = {task: [] for task in by_task}
    for window in load_episodes(policy, source, chosen, WINDOW):
        windows[window.task].append(window)
    return [predict(policy, of_task) for of_task in tqdm(windows.values(), desc="Imagining", unit="task")]


@torch.no_grad()
def predict(policy: ImaginingPolicy, windows: list[Episode]) -> OpenLoop:
    """Filter the first CONTEXT frames of each window, then imagine the rest under its actions.

    Args:
        policy: Holds the world model.
        windows: The first WINDOW frames of episodes of one task.
    """
    world_model, n_cameras = rssm_of(policy), len(policy.config.cameras)
    images = torch.stack([window.images() for window in windows])  # (B, T, C, S, S)
    actions = torch.stack([window.actions[CONTEXT - 1 : -1] for window in windows])  # (B, T - CONTEXT, A)
    latents = imagine(world_model, filter_episodes(world_model, windows), CONTEXT - 1, actions)
    imagined = world_model.decode(latents).cpu()  # (B, T - CONTEXT, C, S, S)
    future, last_seen = images[:, CONTEXT:], images[:, CONTEXT - 1 : CONTEXT]
    return OpenLoop(
        task=windows[0].task,
        n_episodes=len(windows),
        truth=side_by_side(images[0], n_cameras).numpy(),
        imagined=side_by_side(imagined[0], n_cameras).numpy(),
        psnr=_psnr_by_horizon(imagined, future),
        copy_psnr=_psnr_by_horizon(last_seen, future),
    )


def psnr(squared_error: float) -> float:
    """PSNR in dB of a mean squared error of images in [0, 1], at most 100 dB."""
    return -10 * math.log10(max(squared_error, 1e-10))


def _psnr_by_horizon(predicted: Tensor, truth: Tensor) -> list[float]:
    """PSNR in dB at each horizon, images (B, T, C, H, W) in [0, 1]."""
    error = (predicted - truth).square().mean(dim=(0, 2, 3, 4))[[horizon - 1 for horizon in HORIZONS]]
    return [psnr(value) for value in error.tolist()]


def psnr_table(results: list[OpenLoop]) -> ReportTable:
    """Tasks down, horizons across."""
    rows = [
        (
            result.task,
            [
                Measurement(f"{ours:.1f}", f"{copy:.1f}")
                for ours, copy in zip(result.psnr, result.copy_psnr, strict=True)
            ],
        )
        for result in results
    ]
    episodes = max(result.n_episodes for result in results)
    note = (
        f"PSNR in dB (higher is better) of the images imagined after {CONTEXT} frames, at each number of steps ahead, "
        f"over the last episodes of each task (at most {episodes}). In brackets or small print: PSNR of repeating the "
        "last frame seen."
    )
    return ReportTable("Open-loop prediction", "task", [f"+{step}" for step in HORIZONS], rows, notes=[note])


def strips_figure(results: list[OpenLoop]) -> Figure:
    """Two rows per task, truth above imagination: the last context frame, then the horizons."""
    height, width = results[0].truth.shape[-2:]
    figsize = (1.3 * width / height * (len(HORIZONS) + 1), 2.75 * len(results))
    figure = Figure(figsize=figsize, layout="constrained")
    axes = figure.subplots(2 * len(results), len(HORIZONS) + 1, squeeze=False)
    rows: list[tuple[str, list[np.ndarray | None]]] = []
    for result in results:
        truth, imagined = (np.moveaxis(images, 1, -1) for images in (result.truth, result.imagined))
        rows.append((result.task, [truth[CONTEXT - 1 + step] for step in (0, *HORIZONS)]))
        rows.append(("imagined", [None, *(imagined[step - 1] for step in HORIZONS)]))
    draw_pictures(axes, rows)
    for axis, step in zip(axes[0], (0, *HORIZONS), strict=True):
        axis.set_title(f"+{step}" if step else "last seen", fontsize=8)
    return figure
