"""Behaviour cloning."""

from torch import Tensor


def bc_loss(prediction: Tensor, action: Tensor) -> Tensor:
    """Compute the mean squared error between predicted and demonstrated actions, both (B, A) (paper section 3.1.2)."""
    return (prediction.float() - action.float()).square().mean()
