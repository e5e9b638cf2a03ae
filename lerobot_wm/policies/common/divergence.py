"""Training stops at the first loss that is not finite, before it reaches a checkpoint."""

import math
from collections.abc import Mapping
from typing import Any

import torch
from torch import Tensor, nn


class DivergenceError(RuntimeError):
    """A loss or a weight is NaN or infinite. The message is one line: what, and what to do."""


def check_finite(loss: Tensor, parts: Mapping[str, float], config: object, batch: Mapping[str, Any]) -> None:
    """Stop a training whose loss is not finite.

    A policy calls it at the end of `forward`, so that `lerobot-train` stops as `lerobot-wm train` does.

    Args:
        loss: The scalar loss.
        parts: The numbers it was made of, by name.
        config: The policy's configuration, whose settings the message advises on.
        batch: The training batch; its episodes are named where it has `episode_index`.

    Raises:
        DivergenceError: The loss or one of its parts is NaN or infinite.
    """
    broken = [name for name, value in parts.items() if not math.isfinite(value)]
    if not broken and bool(loss.detach().isfinite()):
        return
    what = f"the loss ({', '.join(broken)})" if broken else "the loss"
    where = ""
    if "episode_index" in batch:
        episodes = batch["episode_index"].unique().tolist()  # sorted
        where = f" on a batch of episodes {', '.join(map(str, episodes))}"
    raise DivergenceError(f"Training diverged: {what} is NaN or infinite{where}. {_advice(config)}")


def check_finite_weights(policy: nn.Module, config: object) -> None:
    """Keep weights that are not finite out of a checkpoint: a gradient can be so where the loss is not.

    Args:
        policy: What is to be saved.
        config: Its configuration, whose settings the message advises on.

    Raises:
        DivergenceError: A parameter or buffer is NaN or infinite.
    """
    broken = [name for name, tensor in policy.state_dict().items() if not torch.isfinite(tensor).all()]
    if broken:
        rest = f" and {len(broken) - 1} more" if len(broken) > 1 else ""
        raise DivergenceError(
            f"Training diverged: {broken[0]}{rest} holds NaN or infinite weights. {_advice(config)}"
        )


def _advice(config: object) -> str:
    rate = next(
        (f"--policy.{name}" for name in ("lr", "optimizer_lr") if hasattr(config, name)), "learning rate"
    )
    advice = f"Train again with a lower {rate}"
    if getattr(config, "dtype", None) == "bfloat16":
        advice += ", or in --policy.dtype=float32"
    return f"{advice}. Earlier checkpoints are not affected."
