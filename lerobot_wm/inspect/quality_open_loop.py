"""Open-loop prediction beside what it must beat and what it cannot beat, in image error per horizon."""

import numpy as np
import pandas as pd
import torch
from torch import Tensor
from torchmetrics.functional.image import structural_similarity_index_measure

from lerobot_wm.inspect.open_loop import CONTEXT, HORIZONS, WINDOW, psnr
from lerobot_wm.inspect.quality_episodes import Episode, Filtered
from lerobot_wm.world_model.model import WorldModel
from lerobot_wm.world_model.rssm import RSSMState

# What is compared, in the order shown.
PREDICTIONS = ("open loop", "shuffled actions", "copy last frame", "mean image", "closed loop")
ALL_TASKS = "all tasks"
# A pixel is foreground where a channel differs from the dataset's median image by more than this, of [0, 1]:
# six times the error of the datasets' video codec.
FOREGROUND_THRESHOLD = 0.1
# Steps between the frames that the mean and the median image are made from.
_BACKGROUND_STRIDE = 10


def mean_and_median_image(episodes: list[Episode]) -> tuple[Tensor, Tensor]:
    """Two (C, 64, 64) images in [0, 1]: the best constant prediction, and the scene without what moves."""
    images = torch.cat([episode.images(slice(None, None, _BACKGROUND_STRIDE)) for episode in episodes])
    return images.mean(dim=0), images.median(dim=0).values


def foreground(images: Tensor, median_image: Tensor) -> Tensor:
    """Where images (..., C, H, W) differ from the median image: bool (..., H, W)."""
    return (images - median_image).abs().amax(dim=-3) > FOREGROUND_THRESHOLD


@torch.no_grad()
def predictions(
    world_model: WorldModel, episodes: list[Episode], filtered: list[Filtered], mean_image: Tensor, seed: int
) -> dict[str, Tensor]:
    """Images at each horizon after CONTEXT frames, by `PREDICTIONS`; "truth" stands beside them.

    "shuffled actions" imagines under the actions of another episode, of any task; "closed loop" reconstructs
    from the filter, which sees the image itself.

    Args:
        world_model: The model that filtered.
        episodes: E episodes of at least WINDOW frames.
        filtered: Their closed loops.
        mean_image: (C, 64, 64).
        seed: Seed of the shuffle.

    Returns:
        Each (E, H, C, 64, 64) in [0, 1], on the CPU.
    """
    device = world_model.action_scaling.offset.device
    ahead = [CONTEXT - 1 + horizon for horizon in HORIZONS]
    columns = [horizon - 1 for horizon in HORIZONS]
    context = RSSMState(
        torch.stack([loop.states.deter[CONTEXT - 1] for loop in filtered]).to(device),
        torch.stack([loop.states.stoch[CONTEXT - 1] for loop in filtered]).to(device),
    )  # (E, ·)
    # The first imagined step is reached by the action executed at the last frame seen.
    actions = torch.stack([episode.actions[CONTEXT - 1 : WINDOW - 1] for episode in episodes])  # (E, 45, A)
    order = np.random.default_rng(seed).permutation(len(episodes))
    others = torch.empty_like(actions)
    others[order] = actions[np.roll(order, 1)]  # a single cycle: no episode keeps its own

    def imagined(of_actions: Tensor) -> Tensor:
        latents = world_model.imagine(context, of_actions.to(device)).latent[:, columns]
        return world_model.decode(latents).cpu()

    latents = torch.stack([loop.latents[ahead] for loop in filtered])  # (E, H, D+S)
    truth = torch.stack([episode.images(ahead) for episode in episodes])  # (E, H, C, 64, 64)
    last_seen = torch.stack([episode.images([CONTEXT - 1]) for episode in episodes])  # (E, 1, C, 64, 64)
    return {
        "truth": truth,
        "open loop": imagined(actions),
        "shuffled actions": imagined(others),
        "copy last frame": last_seen.expand_as(truth),
        "mean image": mean_image.expand_as(truth),
        "closed loop": world_model.decode(latents.to(device)).cpu(),
    }


def image_errors(images: dict[str, Tensor], tasks: list[str], median_image: Tensor) -> pd.DataFrame:
    """Error of every predicted image.

    Args:
        images: As `predictions` returns them, each (E, H, C, h, w).
        tasks: The task of each episode.
        median_image: (C, h, w), which tells the foreground of the true images.

    Returns:
        One row per prediction, episode and horizon: `squared_error` (mean over pixels and channels),
        `foreground_error` (the foreground's part of that mean), `foreground_share` of the pixels, `ssim`.
    """
    truth = images["truth"]
    mask = foreground(truth, median_image)  # (E, H, h, w)
    index = pd.MultiIndex.from_product([range(len(tasks)), HORIZONS], names=["episode", "horizon"])
    parts = []
    for name in PREDICTIONS:
        error = (images[name] - truth).square().mean(dim=2)  # (E, H, h, w)
        ssim = structural_similarity_index_measure(
            images[name].flatten(0, 1), truth.flatten(0, 1), data_range=1.0, reduction="none"
        )  # (E·H,)
        assert isinstance(ssim, Tensor)  # a tuple only where the whole map is asked for
        values = {
            "prediction": name,
            "squared_error": error.mean(dim=(2, 3)).flatten().numpy(),
            "foreground_error": (error * mask).mean(dim=(2, 3)).flatten().numpy(),
            "foreground_share": mask.float().mean(dim=(2, 3)).flatten().numpy(),
            "ssim": ssim.numpy(),
        }
        parts.append(pd.DataFrame(values, index=index).reset_index())
    table = pd.concat(parts, ignore_index=True)
    return table.assign(task=table["episode"].map(dict(enumerate(tasks))))


def summarise(errors: pd.DataFrame) -> list[dict]:
    """PSNR and foreground PSNR in dB and SSIM per task, prediction and horizon, and over all tasks.

    Squared errors are averaged over images (foreground: over its pixels) before they are turned into dB. The
    foreground PSNR is None where there is no foreground.
    """
    everything = pd.concat([errors, errors.assign(task=ALL_TASKS)])
    rows = []
    for (task, prediction, horizon), group in everything.groupby(
        ["task", "prediction", "horizon"], sort=False
    ):
        means = group[["squared_error", "foreground_error", "foreground_share", "ssim"]].mean()
        share = float(means["foreground_share"])
        rows.append(
            {
                "task": task,
                "prediction": prediction,
                "horizon": int(horizon),
                "n_episodes": len(group),
                "psnr": psnr(means["squared_error"]),
                "foreground_psnr": psnr(means["foreground_error"] / share) if share else None,
                "foreground_share": share,
                "ssim": float(means["ssim"]),
            }
        )
    return rows
