"""Affine scalings stored as buffers: a checkpoint carries the statistics it was trained with."""

import torch
from torch import Tensor, nn

_EPS = 1e-6


class Affine(nn.Module):
    """x -> (x - offset) / scale per feature, and back.

    An entry whose scale is (nearly) zero is constant in the data. `forward` only shifts it, and `inverse` returns the
    constant for any input.
    """

    offset: Tensor
    scale: Tensor

    def __init__(self, *shape: int) -> None:
        super().__init__()
        self.register_buffer("offset", torch.zeros(shape))
        self.register_buffer("scale", torch.ones(shape))

    def set_standard(self, mean: Tensor, std: Tensor) -> None:
        """Scale to zero mean and unit standard deviation; mean and std are of the module's shape."""
        self._set(mean, std)

    def set_range(self, low: Tensor, high: Tensor) -> None:
        """Scale [low, high] to [-1, 1]; low and high are of the module's shape."""
        self._set((low + high) / 2, (high - low) / 2)

    def _set(self, offset: Tensor, scale: Tensor) -> None:
        if offset.shape != self.offset.shape:
            raise ValueError(
                f"The dataset's statistics have the shape {tuple(offset.shape)}, the model expects "
                f"{tuple(self.offset.shape)}. Recompute the statistics, or use the dataset the model was made for."
            )
        self.offset.copy_(offset)
        self.scale.copy_(torch.where(scale > _EPS, scale, torch.zeros_like(scale)))

    def forward(self, x: Tensor) -> Tensor:
        """Normalize x, (..., *shape)."""
        return (x - self.offset) / torch.where(self.scale > 0, self.scale, 1.0)

    def inverse(self, x: Tensor) -> Tensor:
        """Undo `forward` on x, (..., *shape)."""
        return x * self.scale + self.offset
