"""Several updates of a small policy in one step of LeRobot's loop.

On a GPU an update of a policy on latents is shorter than the rest of a step: the batch, logging, schedule and waits for
the device. As in RLPD (Ball et al. 2023) a large batch is divided among several updates.
"""

from typing import Any

import torch
from lerobot.configs.train import TrainPipelineConfig
from torch import Tensor
from torch.optim import Optimizer

from lerobot_wm.policies.common.features import logged
from lerobot_wm.policies.latent.policy import LatentPolicy


def updates_per_step(cfg: TrainPipelineConfig) -> int:
    """How many updates a step of the run makes; 1 for what is no policy on latents."""
    return getattr(cfg.policy, "updates_per_step", 1)


def check_updates(cfg: TrainPipelineConfig, n_processes: int) -> None:
    """Refuse several updates in a step where they cannot be made.

    Args:
        cfg: Of the run.
        n_processes: How many train together.

    Raises:
        ValueError: They are unequal, or gradients of several processes would have to be averaged for each.
    """
    n = updates_per_step(cfg)
    if n == 1:
        return
    if cfg.batch_size % n:
        raise ValueError(
            f"--batch_size={cfg.batch_size} cannot be divided among --policy.updates_per_step={n}, which share a "
            f"step's batch: give a multiple, --batch_size={n * 256} for updates on 256 samples each."
        )
    if n_processes > 1:
        raise ValueError(
            f"--policy.updates_per_step={n}, but {n_processes} processes train together: train in one, or leave the "
            "flag out (of a policy that was trained with it: --policy.updates_per_step=1)."
        )


class Updates:
    """A step's updates on equal parts of its batch: all but the last are made here, the last by LeRobot's loop.

    Args:
        policy: Prepared for training.
        size: Samples of an update.
        max_norm: Of the gradient, which is clipped to it; 0 leaves it.
    """

    optimizer: Optimizer  # the policy's, set when it is prepared

    def __init__(self, policy: LatentPolicy, size: int, max_norm: float) -> None:
        self._policy = policy
        self._whole = policy.forward
        self._size = size
        self._max_norm = max_norm
        policy.forward = self._forward  # type: ignore[method-assign]  # LeRobot calls it by name

    def _forward(self, batch: dict[str, Any]) -> tuple[Tensor, dict[str, float]]:
        """In training make all updates but the last; the last one's loss and its parts by name."""
        if not self._policy.training:
            return self._whole(batch)
        inputs = self._policy.training_inputs(batch)  # (B, ...) each
        *former, last = zip(*(rows.split(self._size) for rows in inputs), strict=True)
        for part in former:
            self._descend(self._policy.loss(*part)[0])
        loss, parts = self._policy.loss(*last)
        return loss, logged(parts)

    def _descend(self, loss: Tensor) -> None:
        """What LeRobot's loop does with a loss."""
        with torch.autocast(loss.device.type, enabled=False):  # as there, where it has ended with the loss
            loss.backward()
            if self._max_norm > 0:
                torch.nn.utils.clip_grad_norm_(self._policy.parameters(), self._max_norm)
            self.optimizer.step()
            self.optimizer.zero_grad()
        # Of the weights as they were. LeRobot's own context of autocast, around all of this, keeps them.
        torch.clear_autocast_cache()
        if (update := getattr(self._policy, "update", None)) is not None:
            update()
