"""Gaussian noise on a policy's actions at test time."""

import zlib
from typing import Any

import torch
from torch import Tensor


class ActionNoise:
    """One stream of noise per rollout of a batch, seeded by all that the rollout first saw.

    A rollout is so repeatable and does not depend on what else is in its batch, on the order of rollouts or on the
    global random numbers, and two that start differently have different noise.

    Args:
        std: Standard deviation, in the units in which the dataset's actions span [-1, 1].
    """

    def __init__(self, std: float) -> None:
        self.std = std
        self.reset()

    def reset(self) -> None:
        """Forget the streams: the next call begins new rollouts."""
        self._streams: list[torch.Generator] = []

    def __call__(self, action: Tensor, batch: dict[str, Any]) -> Tensor:
        """Add the noise of the next step to scaled actions (B, A), given what `select_action` was."""
        if len(self._streams) != action.shape[0]:
            self._streams = [torch.Generator().manual_seed(_digest(batch, i)) for i in range(action.shape[0])]
        noise = torch.stack([torch.randn(action.shape[1], generator=stream) for stream in self._streams])
        return action + self.std * noise.to(action)


def _digest(batch: dict[str, Any], i: int) -> int:
    """A number made of every bit of the tensors of row i."""
    digest = 0
    for key in sorted(key for key, value in batch.items() if isinstance(value, Tensor) and value.ndim > 1):
        digest = zlib.crc32(batch[key][i].contiguous().cpu().numpy().tobytes(), digest)
    return digest
