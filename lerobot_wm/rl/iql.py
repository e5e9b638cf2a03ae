"""Implicit Q-learning (Kostrikov et al. 2021) as plain functions on tensors.

`beta` multiplies the advantage, as in the paper and the IQL reference (robomimic divides by it).
"""

import math

from torch import Tensor

MAX_WEIGHT = 100.0  # clip of exp(β·A), as in the reference implementation
LOG_STD_RANGE = (-5.0, 2.0)


def expectile_loss(error: Tensor, expectile: float) -> Tensor:
    """Compute the mean of the asymmetric squared error |τ - 1(u < 0)| u²; error is u, (B,)."""
    weight = (error > 0).float() * (2 * expectile - 1) + (1 - expectile)
    return (weight * error.square()).mean()


def value_loss(q: Tensor, v: Tensor, expectile: float) -> Tensor:
    """Regress V(s) on the τ-expectile of the smaller target Q(s, a); q and v are (B,)."""
    return expectile_loss(q.detach() - v, expectile)


def critic_target(reward: Tensor, next_v: Tensor, terminal: Tensor, discount: float) -> Tensor:
    """Compute r + γ (1 - terminal) V(s'), all (B,). Success is terminal, a time limit is not."""
    return reward + discount * (1 - terminal.float()) * next_v.detach()


def critic_loss(qs: Tensor, target: Tensor, valid: Tensor) -> Tensor:
    """Compute the sum of the two critics' mean squared errors.

    Args:
        qs: Q_i(s, a), (2, B).
        target: (B,).
        valid: (B,) bool, False where there is no next observation to bootstrap from.
    """
    weight = valid.float()
    squared = (qs - target.detach()).square() * weight  # (2, B)
    return squared.sum() / weight.sum().clamp(min=1)


def advantage_weight(advantage: Tensor, beta: float) -> Tensor:
    """Compute exp(β·A), clipped at 100, without gradient: (B,)."""
    return (beta * advantage.detach()).exp().clamp(max=MAX_WEIGHT)


def gaussian_log_prob(mean: Tensor, log_std: Tensor, action: Tensor) -> Tensor:
    """Compute log N(action; mean, exp(log_std)), summed over the action's axes: (B,).

    Args:
        mean: (B, A). The network bounds the mean, but the Gaussian is not squashed: demonstrated actions lie on the
            bounds at nearly every step, where the density of a squashed Gaussian explodes.
        log_std: (A,), clamped to [-5, 2].
        action: (B, A).
    """
    log_std = log_std.clamp(*LOG_STD_RANGE)
    scaled = (action - mean) / log_std.exp()
    return -(0.5 * scaled.square() + log_std + 0.5 * math.log(2 * math.pi)).sum(-1)


def actor_loss(weight: Tensor, log_prob: Tensor) -> Tensor:
    """Compute the advantage-weighted regression loss -mean(weight · log π(a|s)); both are (B,)."""
    return -(weight * log_prob).mean()
