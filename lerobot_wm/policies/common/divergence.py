"""Training stops at the first loss that is not finite, before it reaches a checkpoint."""

import math
from collections.abc import Mapping
from typing import Any

import torch
from torch import nn


class DivergenceError(RuntimeError):
    """A loss or a weight is NaN or infinite. The message is one line: what, and what to do."""


def check_finite(numbers: Mapping[str, float], config: object, batch: Mapping[str, Any]) -> None:
    """Stop a training whose loss is not finite.

    Every policy's `forward` calls it, so that `lerobot-train` stops as `lerobot-wm train` does.

    Args:
        numbers: The loss and its parts, by name.
        config: The policy's configuration, whose settings the message advises on.
        batch: The training batch; its episodes are named where it has `episode_index`.

    Raises:
        DivergenceError: A number is NaN or infinite.
    """
    broken = [name for name, value in numbers.items() if not math.isfinite(value)]
    if not broken:
        return
    where = ""
    if "episode_index" in batch:
        episodes = batch["episode_index"].unique().tolist()  # sorted
        where = f" on a batch of episodes {', '.join(map(str, episodes))}"
    raise DivergenceError(
        f"Training diverged: {', '.join(broken)} is NaN or infinite{where}. {_advice(config)}"
    )


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
