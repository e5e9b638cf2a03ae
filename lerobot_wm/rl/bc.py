"""Behaviour cloning."""

from torch import Tensor


def bc_loss(prediction: Tensor, action: Tensor, is_pad: Tensor | None = None) -> Tensor:
    """The mean squared error between predicted and demonstrated actions (paper section 3.1.2).

    Args:
        prediction: (B, A), or chunks (B, K, A).
        action: Of the same shape.
        is_pad: (B, K) bool, True for actions past the end of an episode, which are left out.
    """
    return mean_without_padding((prediction.float() - action.float()).square(), is_pad)


def mean_without_padding(error: Tensor, is_pad: Tensor | None) -> Tensor:
    """The mean of errors (B, K, A), of which those where `is_pad` (B, K) are left out; of all without it."""
    if is_pad is None:
        return error.mean()
    valid = ~is_pad[..., None].expand_as(error)
    return (error * valid).sum() / valid.sum()
