"""What both sides of a row share: settings of IQL and BC, and weights, batch and noise of the world model."""

from pathlib import Path

import torch
from torch import Tensor

# Equal to those of `wm_iql` and `wm_bc`. An observation is a latent, a one-hot task and proprioception.
OBSERVATION_DIM = 512 + 6 + 4
ACTION_DIM = 4
HIDDEN_DIMS = [256, 256]
DROPOUT = 0.1
LEARNING_RATE = 3e-4
BETA = 0.5
EXPECTILE = 0.7
DISCOUNT = 0.99
TARGET_RATE = 0.005


def batch_file(folder: Path, batch: int, length: int) -> Path:
    """Return the file in which our side saves its weights and batch for the peer."""
    return folder / f"world_model-{batch}x{length}.pt"


def half_noise(like: Tensor) -> Tensor:
    """Replace `torch.randn_like` while losses are compared: z is the mean plus half a standard deviation."""
    return torch.full_like(like, 0.5)
