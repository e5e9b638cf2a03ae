"""Measures of a world model: image error in open loop; predicted reward, KL and drift in the closed loop."""

import numpy as np
import pandas as pd
import torch
from sklearn.metrics import average_precision_score, roc_auc_score
from torch import Tensor
from torchmetrics.functional.image import structural_similarity_index_measure

from lerobot_wm.constants import SUCCESS
from lerobot_wm.encode.episodes import Episode
from lerobot_wm.inspect.episodes import Filtered, imagine
from lerobot_wm.inspect.open_loop import CONTEXT, HORIZONS, WINDOW, psnr
from lerobot_wm.world_model.model import WorldModel

# What is compared, in the order shown.
PREDICTIONS = ("open loop", "shuffled actions", "copy last frame", "mean image", "closed loop")
ALL_TASKS = "all tasks"
# A pixel is foreground where a channel differs from the dataset's median image by more than this, of [0, 1]: six times
# the error of the datasets' video codec.
FOREGROUND_THRESHOLD = 0.1
# Steps between the frames that the mean and the median image are made of.
_BACKGROUND_STRIDE = 10
DRIFT_STEPS = 101
KL_BINS = 40
_PERCENTILES = (5, 25, 50, 75, 95)


def mean_and_median_image(episodes: list[Episode]) -> tuple[Tensor, Tensor]:
    """Two (C, S, S) images in [0, 1]: the best constant prediction, and the scene without what moves."""
    images = torch.cat([episode.images(slice(None, None, _BACKGROUND_STRIDE)) for episode in episodes])
    return images.mean(dim=0), images.median(dim=0).values


@torch.no_grad()
def predictions(
    world_model: WorldModel, episodes: list[Episode], filtered: list[Filtered], mean_image: Tensor, seed: int
) -> dict[str, Tensor]:
    """Predict the images at each horizon after CONTEXT frames in the ways of `PREDICTIONS`, and add the "truth".

    "shuffled actions" imagines under the actions of another episode, of any task; "closed loop" decodes the filter's
    states, which have seen the image itself.

    Args:
        world_model: The model that filtered.
        episodes: E episodes of at least WINDOW frames.
        filtered: Their closed loops.
        mean_image: (C, S, S).
        seed: Seed of the shuffle.

    Returns:
        Each (E, H, C, S, S) in [0, 1], on the CPU.
    """
    device = world_model.action_scaling.offset.device
    ahead = [CONTEXT - 1 + horizon for horizon in HORIZONS]
    columns = [horizon - 1 for horizon in HORIZONS]
    actions = torch.stack([episode.actions[CONTEXT - 1 : WINDOW - 1] for episode in episodes])  # (E, 45, A)
    order = np.random.default_rng(seed).permutation(len(episodes))
    others = torch.empty_like(actions)
    # A single cycle: no episode keeps its own actions.
    others[order] = actions[np.roll(order, 1)]

    def under(chosen: Tensor) -> Tensor:
        latents = imagine(world_model, filtered, CONTEXT - 1, chosen)[:, columns]
        return world_model.decode(latents).cpu()

    latents = torch.stack([loop.latents[ahead] for loop in filtered])  # (E, H, D+S)
    truth = torch.stack([episode.images(ahead) for episode in episodes])  # (E, H, C, S, S)
    last_seen = torch.stack([episode.images([CONTEXT - 1]) for episode in episodes])  # (E, 1, C, S, S)
    return {
        "truth": truth,
        "open loop": under(actions),
        "shuffled actions": under(others),
        "copy last frame": last_seen.expand_as(truth),
        "mean image": mean_image.expand_as(truth),
        "closed loop": world_model.decode(latents.to(device)).cpu(),
    }


def image_errors(images: dict[str, Tensor], tasks: list[str], median_image: Tensor) -> pd.DataFrame:
    """Error of every predicted image.

    Args:
        images: As `predictions` returns them, each (E, H, C, h, w).
        tasks: The task of each episode.
        median_image: (C, h, w); the true images' pixels that differ from it are the foreground.

    Returns:
        One row per prediction, episode and horizon: `squared_error` (mean over pixels and channels),
        `foreground_error` (the foreground's contribution to that mean), `foreground_share` of the pixels, `ssim`.
    """
    truth = images["truth"]
    foreground = (truth - median_image).abs().amax(dim=-3) > FOREGROUND_THRESHOLD  # (E, H, h, w)
    index = pd.MultiIndex.from_product([range(len(tasks)), HORIZONS], names=["episode", "horizon"])
    tables = []
    for name in PREDICTIONS:
        error = (images[name] - truth).square().mean(dim=2)  # (E, H, h, w)
        ssim = structural_similarity_index_measure(
            images[name].flatten(0, 1), truth.flatten(0, 1), data_range=1.0, reduction="none"
        )  # (E·H,)
        # A tuple only where the whole map is asked for.
        assert isinstance(ssim, Tensor)
        values = {
            "prediction": name,
            "squared_error": error.mean(dim=(2, 3)).flatten().numpy(),
            "foreground_error": (error * foreground).mean(dim=(2, 3)).flatten().numpy(),
            "foreground_share": foreground.float().mean(dim=(2, 3)).flatten().numpy(),
            "ssim": ssim.numpy(),
        }
        tables.append(pd.DataFrame(values, index=index).reset_index())
    table = pd.concat(tables, ignore_index=True)
    return table.assign(task=table["episode"].map(dict(enumerate(tasks))))


def summarise(errors: pd.DataFrame) -> list[dict]:
    """PSNR and foreground PSNR in dB and SSIM per task, prediction and horizon, and over all tasks.

    Squared errors are averaged over images (foreground: over its pixels) before they become dB. The foreground PSNR is
    None where there is no foreground.
    """
    rows = []
    for (task, prediction, horizon), group in _with_all_tasks(errors).groupby(
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


@torch.no_grad()
def reward_quality(
    world_model: WorldModel, episodes: list[Episode], filtered: list[Filtered], reward_key: str
) -> list[dict] | None:
    """How well the predicted reward ranks successful steps above others, per task and over all tasks.

    None where the dataset does not say which steps succeed: it has no `next.success`, and no reward of 0 and 1.

    s_t predicts the reward r_{t-1} that arrived with o_t; the label is `next.success` of frame t - 1, so that models of
    any reward can be compared. By chance AUROC is 0.5 and average precision the base rate; both are None where all
    steps succeed or all fail.
    """
    device = world_model.action_scaling.offset.device
    key = SUCCESS if SUCCESS in episodes[0].columns else reward_key
    success = [episode.columns[key] for episode in episodes if key in episode.columns]
    if not success or not all(((values == 0) | (values == 1)).all() for values in success):
        return None
    steps = pd.concat(
        pd.DataFrame(
            {
                "task": episode.task,
                "score": world_model.predict_reward(loop.latents[1:].to(device)).cpu().numpy(),
                "success": values[:-1].flatten().bool().numpy(),
            }
        )
        for episode, loop, values in zip(episodes, filtered, success, strict=True)
    )
    rows = []
    for task, group in _with_all_tasks(steps).groupby("task", sort=False):
        success, score = group["success"], group["score"]
        can_rank = success.nunique() == 2
        rows.append(
            {
                "task": task,
                "n_steps": len(group),
                "base_rate": float(success.mean()),
                "auroc": float(roc_auc_score(success, score)) if can_rank else None,
                "average_precision": float(average_precision_score(success, score)) if can_rank else None,
            }
        )
    return rows


def kl_quality(episodes: list[Episode], filtered: list[Filtered], free_nats: float) -> dict:
    """Distribution of KL(posterior || prior) per step in nats, and the share of steps below the free nats.

    A KL just below the free nats says that z_t holds no more of the image than training asks for.
    """
    kl = pd.concat(
        pd.DataFrame({"task": episode.task, "kl": loop.kl.numpy()})
        for episode, loop in zip(episodes, filtered, strict=True)
    )
    # The last bin takes the tail, such as an episode's first step, whose prior knows nothing.
    edges = np.linspace(0, kl["kl"].quantile(0.99), KL_BINS + 1)
    counts, _ = np.histogram(kl["kl"].clip(upper=edges[-1]), bins=edges)
    return {
        "free_nats": free_nats,
        "tasks": [
            {
                "task": task,
                "n_steps": len(values),
                "mean": float(values.mean()),
                "percentiles": {str(p): float(np.percentile(values, p)) for p in _PERCENTILES},
                "share_under_free_nats": float((values < free_nats).mean()),
            }
            for task, values in _with_all_tasks(kl).groupby("task", sort=False)["kl"]
        ],
        "histogram": {"edges": edges.tolist(), "counts": counts.tolist()},
    }


@torch.no_grad()
def drift(
    world_model: WorldModel, episodes: list[Episode], filtered: list[Filtered], window_length: int
) -> list[dict]:
    """Reconstruction and KL by step index, over whole episodes.

    The filter that runs from the first frame on is compared with one restarted so late that it has seen `window_length`
    frames, as in training. Where the restarted one is better at the same frames, the filter drifts.

    Returns:
        One row per step index: `n_episodes` that reach it, mean `kl`, `psnr` and `restarted_psnr` in dB (None before a
        whole window has passed).
    """
    tables = []
    for episode, loop in zip(episodes, filtered, strict=True):
        steps = min(len(episode), DRIFT_STEPS)
        truth = episode.images(slice(steps))  # (T, C, S, S)
        restarted = torch.full((steps,), torch.nan)
        if steps >= window_length:
            latents = _restarted_latents(
                world_model, loop.embeds[:steps], episode.actions[:steps], window_length
            )
            restarted[window_length - 1 :] = _squared_error(world_model, latents, truth[window_length - 1 :])
        values = {
            "step": range(steps),
            "kl": loop.kl[:steps].numpy(),
            "error": _squared_error(world_model, loop.latents[:steps], truth).numpy(),
            "restarted_error": restarted.numpy(),
        }
        tables.append(pd.DataFrame(values))
    by_step = pd.concat(tables).groupby("step")
    means, counts = by_step.mean(), by_step.size()
    return [
        {
            "step": int(step),
            "n_episodes": int(counts[step]),
            "kl": float(row["kl"]),
            "psnr": psnr(row["error"]),
            "restarted_psnr": None if np.isnan(row["restarted_error"]) else psnr(row["restarted_error"]),
        }
        for step, row in means.iterrows()
    ]


def _restarted_latents(
    world_model: WorldModel, embeds: Tensor, actions: Tensor, window_length: int
) -> Tensor:
    """s_t of filters that start W - 1 steps before t: (T, E), (T, A) -> (T - W + 1, D+S)."""
    device = world_model.action_scaling.offset.device
    windows = [
        x.unfold(0, window_length, 1).movedim(-1, 1).to(device) for x in (embeds, actions)
    ]  # (N, W, ·)
    return world_model.filter_embeds(*windows).last().latent


def _squared_error(world_model: WorldModel, latents: Tensor, truth: Tensor) -> Tensor:
    """Mean squared error of each reconstruction, (T, D+S) and (T, C, S, S) -> (T,) on the CPU."""
    decoded = world_model.decode(latents.to(world_model.action_scaling.offset.device)).cpu()
    return (decoded - truth).square().mean(dim=(1, 2, 3))


def _with_all_tasks(table: pd.DataFrame) -> pd.DataFrame:
    """The table's rows by task, then all of them again as one task."""
    return pd.concat([table, table.assign(task=ALL_TASKS)])
