"""Optimizer and schedule presets that LeRobot does not have."""

from dataclasses import asdict, dataclass
from math import cos, pi
from typing import Any

import torch
from lerobot.optim import LRSchedulerConfig, OptimizerConfig
from torch.optim.lr_scheduler import LambdaLR


@OptimizerConfig.register_subclass("fused_adam")
@dataclass
class FusedAdamConfig(OptimizerConfig):
    """Adam with PyTorch's fused kernel, several times faster than the default loop on CPUs."""

    lr: float = 3e-4
    betas: tuple[float, float] = (0.9, 0.999)
    eps: float = 1e-8
    weight_decay: float = 0.0
    grad_clip_norm: float = 0.0

    def build(self, params: Any) -> torch.optim.Optimizer:
        """The optimizer over `params` (parameters or groups of them)."""
        kwargs = asdict(self)
        kwargs.pop("grad_clip_norm")
        return torch.optim.Adam(params, fused=True, **kwargs)


@LRSchedulerConfig.register_subclass("actor_cosine")
@dataclass
class ActorCosineConfig(LRSchedulerConfig):
    """Cosine decay to zero on the first parameter group (IQL's actor), constant rates on the others."""

    # LeRobot's base class declares it; this schedule has no warm-up.
    num_warmup_steps: int | None = None

    def build(self, optimizer: torch.optim.Optimizer, num_training_steps: int) -> LambdaLR:
        """The schedule over `num_training_steps` updates."""

        def cosine(step: int) -> float:
            return 0.5 * (1 + cos(pi * min(step, num_training_steps) / num_training_steps))

        def constant(step: int) -> float:
            return 1.0

        others = len(optimizer.param_groups) - 1
        return LambdaLR(optimizer, [cosine, *[constant] * others])


@LRSchedulerConfig.register_subclass("final_decay")
@dataclass
class FinalDecayConfig(LRSchedulerConfig):
    """A constant rate that falls linearly to zero over the last part of training.

    Args:
        share: Part of the steps over which it falls, above 0 and at most 1.
        num_warmup_steps: LeRobot's base class declares it; this schedule has no warm-up.
    """

    share: float = 0.2
    num_warmup_steps: int | None = None

    def build(self, optimizer: torch.optim.Optimizer, num_training_steps: int) -> LambdaLR:
        """The schedule over `num_training_steps` updates."""
        falling = self.share * num_training_steps

        def rate(step: int) -> float:
            return min(1.0, max(0.0, (num_training_steps - step) / falling))

        return LambdaLR(optimizer, rate)
