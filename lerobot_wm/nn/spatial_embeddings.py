"""Learned spatial embeddings: pooling of a feature map that keeps where things are."""

import torch
from torch import Tensor, nn


class SpatialEmbeddings(nn.Module):
    """F learned weighted sums over the positions of each channel (PTR, Kumar et al. 2022).

    Average pooling forgets position; a weight per channel and position keeps it at C·F outputs.

    Args:
        channels: C of the feature map.
        height: Its H.
        width: Its W.
        num_features: F, the weighted sums per channel.
    """

    def __init__(self, channels: int, height: int, width: int, num_features: int = 8) -> None:
        super().__init__()
        self.kernel = nn.Parameter(torch.empty(channels, height, width, num_features))  # (C, H, W, F)
        nn.init.normal_(self.kernel, std=(height * width) ** -0.5)  # one over the fan-in of each sum

    @property
    def output_dim(self) -> int:
        """C·F."""
        return self.kernel.shape[0] * self.kernel.shape[3]

    def forward(self, features: Tensor) -> Tensor:
        """Map a feature map (N, C, H, W) to (N, C·F)."""
        return torch.einsum("nchw,chwf->ncf", features, self.kernel).flatten(1)
