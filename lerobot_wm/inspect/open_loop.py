"""Open-loop prediction: the world model sees five frames, then imagines from actions alone."""

import logging
import math
from dataclasses import dataclass
from textwrap import fill
from typing import Any

import numpy as np
import torch
from lerobot.datasets.dataset_metadata import LeRobotDatasetMetadata
from matplotlib.figure import Figure
from torch import Tensor
from tqdm import tqdm

from lerobot_wm.constants import ACTION, OBS_STATE, TASK
from lerobot_wm.data.options import SourceConfig
from lerobot_wm.inspect.episodes import episodes_by_task, read_episodes, shapes_read
from lerobot_wm.policies.common.cameras import camera_images, side_by_side
from lerobot_wm.policies.latent.encoder import load_encoder
from lerobot_wm.policies.latent.policy import LatentPolicy
from lerobot_wm.policies.wm_rssm.modeling_wm_rssm import WMRSSMPolicy
from lerobot_wm.world_model.model import WorldModel

logger = logging.getLogger(__name__)

CONTEXT = 5  # frames the model sees
HORIZONS = (1, 5, 10, 20, 45)  # frames ahead of the last one it saw
WINDOW = CONTEXT + HORIZONS[-1]
EPISODES_PER_TASK = 4


@dataclass(frozen=True)
class OpenLoop:
    """Predictions on one task's episodes, from their first frames on.

    `truth` (CONTEXT + H, C, H, W) and `imagined` (H, C, H, W) are the first episode's images in [0, 1], several
    cameras side by side. PSNR is in dB by horizon, from the squared error averaged over the pixels of all cameras and
    over episodes; `copy_psnr` is that of repeating the last frame seen.
    """

    task: str
    n_episodes: int
    truth: np.ndarray
    imagined: np.ndarray
    psnr: list[float]
    copy_psnr: list[float]


def load_world_model(path: str) -> WMRSSMPolicy | LatentPolicy:
    """A checkpoint, see `load_encoder`, that holds an RSSM: wm_rssm, or a policy on its latents.

    Raises:
        ValueError: the checkpoint holds none.
    """
    policy = load_encoder(path)
    if not isinstance(policy, WMRSSMPolicy | LatentPolicy) or not isinstance(policy.world_model, WorldModel):
        raise ValueError(
            f"{path} ({policy.config.type}) holds no world model that imagines images: give a wm_rssm checkpoint, or "
            "one of a policy on its latents."
        )
    return policy.eval()


def open_loop(
    policy: WMRSSMPolicy | LatentPolicy, meta: LeRobotDatasetMetadata, source: SourceConfig
) -> list[OpenLoop]:
    """Predict the last episodes of each task (those LeRobot's `eval_split` holds out); none where all are shorter.

    Args:
        policy: Holds the world model.
        meta: A dataset that it can read, see `check_features`.
        source: Where it is.
    """
    by_task = episodes_by_task(meta, min_length=WINDOW)
    if not by_task:
        logger.warning(
            "%s has no episode of %d frames, which open-loop prediction needs.", meta.repo_id, WINDOW
        )
        return []
    chosen = sorted(index for episodes in by_task.values() for index in episodes[-EPISODES_PER_TASK:])
    windows: dict[str, list[dict[str, Any]]] = {task: [] for task in by_task}
    read = read_episodes(policy, meta, source, chosen, WINDOW)
    for window in tqdm(read, total=len(chosen), desc="Imagining", unit="episode"):
        windows[window[TASK]].append(window)
    return [predict(policy, task, of_task) for task, of_task in windows.items()]


@torch.no_grad()
def predict(policy: WMRSSMPolicy | LatentPolicy, task: str, windows: list[dict[str, Any]]) -> OpenLoop:
    """Filter the first CONTEXT frames of each window, imagine the rest under its actions.

    Args:
        policy: holds the world model.
        task: what the windows show.
        windows: each the first WINDOW frames of an episode, as of `read_episodes`.
    """
    config, world_model = policy.config, policy.world_model
    assert isinstance(world_model, WorldModel)  # as load_world_model checked
    batch = {
        key: torch.stack([window[key] for window in windows]).to(config.device) for key in shapes_read(policy)
    }
    images, actions = camera_images(config, batch), batch[ACTION]  # (B, T, C, 64, 64), (B, T, A)
    proprio = batch[OBS_STATE][:, :CONTEXT] if world_model.config.use_proprio else None
    context = world_model.filter(images[:, :CONTEXT], actions[:, :CONTEXT], proprio)
    # The first imagined step is reached by the action executed at the last frame seen.
    states = world_model.imagine(context.last(), actions[:, CONTEXT - 1 : -1])
    imagined = world_model.decode(states.latent)  # (B, T - CONTEXT, C, 64, 64)
    future, last_seen = images[:, CONTEXT:], images[:, CONTEXT - 1 : CONTEXT]
    return OpenLoop(
        task=task,
        n_episodes=len(windows),
        truth=side_by_side(images[0], len(config.cameras)).cpu().numpy(),
        imagined=side_by_side(imagined[0], len(config.cameras)).cpu().numpy(),
        psnr=_psnr(imagined, future),
        copy_psnr=_psnr(last_seen, future),
    )


def psnr(squared_error: float) -> float:
    """PSNR in dB of a mean squared error of images in [0, 1]; images that are equal are given 100 dB."""
    return -10 * math.log10(max(squared_error, 1e-10))


def strips_figure(results: list[OpenLoop]) -> Figure:
    """Two rows per task, truth above imagination: the last context frame, then the horizons."""
    height, width = results[0].truth.shape[-2:]
    figsize = (1.3 * width / height * (len(HORIZONS) + 1), 2.75 * len(results))
    figure = Figure(figsize=figsize, layout="constrained")
    axes = figure.subplots(2 * len(results), len(HORIZONS) + 1, squeeze=False)
    for axis in axes.flat:
        axis.axis("off")
    for result, (above, below) in zip(results, axes.reshape(len(results), 2, -1), strict=True):
        above[0].imshow(_pixels(result.truth[CONTEXT - 1]))
        above[0].set_title("last seen", fontsize=8)
        transform = below[0].transAxes
        name = below[0].text(0, 0.5, fill(result.task, 14), fontsize=8, transform=transform, va="center")
        name.set_in_layout(False)  # or it would widen its column
        for column, horizon in enumerate(HORIZONS, start=1):
            above[column].imshow(_pixels(result.truth[CONTEXT - 1 + horizon]))
            above[column].set_title(f"+{horizon}", fontsize=8)
            below[column].imshow(_pixels(result.imagined[horizon - 1]))
    return figure


def _psnr(predicted: Tensor, truth: Tensor) -> list[float]:
    """PSNR in dB at each horizon, images (B, T, C, H, W) in [0, 1]."""
    error = (predicted - truth).square().mean(dim=(0, 2, 3, 4))[[horizon - 1 for horizon in HORIZONS]]
    return [psnr(value) for value in error.tolist()]


def _pixels(image: np.ndarray) -> np.ndarray:
    """(C, H, W) -> (H, W, C)."""
    return image.transpose(1, 2, 0)
