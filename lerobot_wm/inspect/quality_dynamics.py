"""What the closed loop tells of the latents: predicted reward, KL of posterior and prior, drift over an episode."""

import numpy as np
import pandas as pd
import torch
from sklearn.metrics import average_precision_score, roc_auc_score
from torch import Tensor

from lerobot_wm.inspect.open_loop import psnr
from lerobot_wm.inspect.quality_episodes import Episode, Filtered
from lerobot_wm.inspect.quality_open_loop import ALL_TASKS
from lerobot_wm.world_model.model import WorldModel

DRIFT_STEPS = 101  # step indices 0..100
KL_BINS = 40
_PERCENTILES = (5, 25, 50, 75, 95)


@torch.no_grad()
def reward_quality(world_model: WorldModel, episodes: list[Episode], filtered: list[Filtered]) -> list[dict]:
    """How well the predicted reward ranks successful steps above others, per task and over all tasks.

    s_t predicts the reward r_{t-1} that arrived with o_t; the label is `next.success` of frame t - 1, so that
    rewards of another scale can be judged too. AUROC is 0.5 and average precision the base rate by chance; both
    are None where all steps are alike.
    """
    device = world_model.action_scaling.offset.device
    parts = [
        pd.DataFrame(
            {
                "task": episode.task,
                "score": world_model.predict_reward(loop.latents[1:].to(device)).cpu().numpy(),
                "success": episode.success[:-1].numpy(),
            }
        )
        for episode, loop in zip(episodes, filtered, strict=True)
    ]
    steps = pd.concat(parts)
    rows = []
    for task, group in pd.concat([steps, steps.assign(task=ALL_TASKS)]).groupby("task", sort=False):
        both = group["success"].nunique() == 2
        rows.append(
            {
                "task": task,
                "n_steps": len(group),
                "base_rate": float(group["success"].mean()),
                "auroc": float(roc_auc_score(group["success"], group["score"])) if both else None,
                "average_precision": (
                    float(average_precision_score(group["success"], group["score"])) if both else None
                ),
            }
        )
    return rows


def kl_quality(episodes: list[Episode], filtered: list[Filtered], free_nats: float) -> dict:
    """Distribution of KL(posterior || prior) per step in nats, and the share of steps under the free nats.

    A KL that sits just under the free nats says that z_t carries no more of the image than training asks for.
    """
    kl = pd.concat(
        [
            pd.DataFrame({"task": episode.task, "kl": loop.kl.numpy()})
            for episode, loop in zip(episodes, filtered, strict=True)
        ]
    )
    by_task = pd.concat([kl, kl.assign(task=ALL_TASKS)]).groupby("task", sort=False)["kl"]
    # The last bin takes the tail, such as the first step of an episode, whose prior knows nothing.
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
            for task, values in by_task
        ],
        "histogram": {"edges": edges.tolist(), "counts": counts.tolist()},
    }


@torch.no_grad()
def drift(
    world_model: WorldModel, episodes: list[Episode], filtered: list[Filtered], window_length: int
) -> list[dict]:
    """Reconstruction and KL by step index, over whole episodes.

    Beside the filter that runs from the first frame on stands one that was restarted so many steps before that it has
    seen `window_length` frames, as in training: what it does better at the same frames is drift, the rest is the
    scene's change.

    Returns:
        One row per step index: `n_episodes` that reach it, mean `kl`, `psnr` and `restarted_psnr` in dB (None
        before a whole window has passed).
    """
    parts = []
    for episode, loop in zip(episodes, filtered, strict=True):
        steps = min(len(episode.actions), DRIFT_STEPS)
        truth = episode.images(slice(steps))  # (T, C, 64, 64)
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
        parts.append(pd.DataFrame(values))
    by_step = pd.concat(parts).groupby("step")
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
    """Mean squared error of each reconstruction, (T, D+S) and (T, C, 64, 64) -> (T,) on the CPU."""
    decoded = world_model.decode(latents.to(world_model.action_scaling.offset.device)).cpu()
    return (decoded - truth).square().mean(dim=(1, 2, 3))
