"""The parts of a loss as LeRobot logs them."""

import torch
from torch import Tensor


def logged(parts: dict[str, Tensor]) -> dict[str, float]:
    """Scalars by name as numbers, in one transfer from the device for all of them."""
    if not parts:
        return {}
    return dict(zip(parts, torch.stack(list(parts.values())).tolist(), strict=True))
