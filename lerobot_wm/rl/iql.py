"""Implicit Q-learning (Kostrikov et al. 2021): its losses as plain functions, and the agent.

`beta` multiplies the advantage, as in the paper and the IQL reference (robomimic divides by it).
"""

import math
from collections.abc import Sequence
from copy import deepcopy
from typing import Any

import torch
from torch import Tensor, nn

from lerobot_wm.nn.mlp import MLP, orthogonal_init

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


class GaussianActor(nn.Module):
    """N(tanh MLP, exp(log_std)) with a standard deviation that does not depend on the observation."""

    def __init__(
        self, observation_dim: int, action_dim: int, hidden_dims: Sequence[int], dropout: float
    ) -> None:
        super().__init__()
        self.mlp = MLP(observation_dim, hidden_dims, action_dim, nn.ReLU, dropout)
        self.log_std = nn.Parameter(torch.zeros(action_dim))

    def forward(self, observation: Tensor) -> tuple[Tensor, Tensor]:
        """Compute the mean (B, A) in (-1, 1) and the log-std (A,) for observations (B, O)."""
        return self.mlp(observation).tanh(), self.log_std


class TwinCritic(nn.Module):
    """Two independent Q functions of (observation, action)."""

    def __init__(self, input_dim: int, hidden_dims: Sequence[int]) -> None:
        super().__init__()
        self.critics = nn.ModuleList(MLP(input_dim, hidden_dims, 1, nn.ReLU) for _ in range(2))

    def forward(self, observation: Tensor, action: Tensor) -> Tensor:
        """Compute the Q values (2, B) of observations (B, O) and actions (B, A)."""
        x = torch.cat([observation, action], dim=-1)
        return torch.stack([critic(x).squeeze(-1) for critic in self.critics])


class IQLAgent(nn.Module):
    """Twin critics with Polyak targets, a value function, and one actor per inverse temperature β.

    LeRobot's loop makes one backward pass and one optimizer step, so all losses are computed with the same parameters.
    The reference implementation updates V before Q uses it; here Q uses the V of the step before.

    Args:
        observation_dim: O.
        action_dim: A.
        betas: β of each actor; the first is the main one. IQL learns Q and V without an actor, so all actors share
            them. The other actors send no gradient into the observations. Without dropout, whose masks share one random
            generator, the main actor trains bit for bit the same with and without them.
        hidden_dims: Widths of the hidden layers of every network.
        dropout: Dropout of the actors.
        expectile: τ of the value regression.
        discount: γ.
        target_rate: Polyak rate of the target critics.
    """

    def __init__(
        self,
        observation_dim: int,
        action_dim: int,
        *,
        betas: Sequence[float],
        hidden_dims: Sequence[int],
        dropout: float,
        expectile: float,
        discount: float,
        target_rate: float,
    ) -> None:
        super().__init__()
        self.betas = list(betas)
        self.expectile = expectile
        self.discount = discount
        self.target_rate = target_rate

        def make_actor() -> GaussianActor:
            return GaussianActor(observation_dim, action_dim, hidden_dims, dropout)

        self.actors = nn.ModuleList([make_actor()])
        self.critic = TwinCritic(observation_dim + action_dim, hidden_dims)
        self.value = MLP(observation_dim, hidden_dims, 1, nn.ReLU)
        for network in (self.actors, self.critic, self.value):
            orthogonal_init(network)
        self.target_critic = deepcopy(self.critic).requires_grad_(False)
        # Created last, so that the networks above get the same random numbers with and without them.
        for _ in self.betas[1:]:
            self.actors.append(make_actor())
        orthogonal_init(self.actors[1:])

    def networks(self) -> list[MLP]:
        """List the networks whose input starts with the observation."""
        return [module for module in self.modules() if isinstance(module, MLP)]

    def param_groups(self) -> list[dict[str, Any]]:
        """Return three optimizer groups. The actors come first: only their learning rate decays."""
        return [{"params": list(network.parameters())} for network in (self.actors, self.critic, self.value)]

    def mean_action(self, observation: Tensor, beta: float) -> Tensor:
        """Compute the mean action (B, A) in [-1, 1] of the actor trained with `beta`, for observations (B, O)."""
        return self.actors[self.betas.index(beta)](observation)[0]

    def loss(
        self,
        observation: Tensor,
        next_observation: Tensor,
        action: Tensor,
        reward: Tensor,
        terminal: Tensor,
        has_next: Tensor,
    ) -> tuple[Tensor, dict[str, Tensor]]:
        """Compute the value, critic and actor losses on a batch of transitions.

        Args:
            observation: At t, (B, O). Critic, value and main actor send gradients into it.
            next_observation: At t+1, (B, O); gets no gradient.
            action: Scaled to [-1, 1], (B, A).
            reward: (B,).
            terminal: (B,) bool, True where the step ends the task. A time limit does not.
            has_next: (B,) bool, False where the data ends at t, so that `next_observation` is not the successor.

        Returns:
            The sum of the losses, and its parts by name as detached scalars. The losses of further actors are named
            `actor_loss_beta<β>`.
        """
        # This comes before the pass without gradient: there, autocast before PyTorch 2.11 would cache the cast weights
        # without gradient and reuse them here.
        v = self.value(observation).squeeze(-1)  # (B,)
        with torch.no_grad():
            target_q = self.target_critic(observation, action).amin(0)  # (B,)
            next_v = self.value(next_observation).squeeze(-1)  # (B,)
        qs = self.critic(observation, action)  # (2, B)
        target = critic_target(reward, next_v, terminal, self.discount)  # (B,)
        advantage = target_q - v  # (B,)
        losses = {
            "value_loss": value_loss(target_q, v, self.expectile),
            # The last frame of an episode has no successor. Unless the task ended there, its target is unknown.
            "critic_loss": critic_loss(qs, target, terminal | has_next),
        }
        for i, (beta, actor) in enumerate(zip(self.betas, self.actors, strict=True)):
            mean, log_std = actor(observation if i == 0 else observation.detach())  # (B, A), (A,)
            log_prob = gaussian_log_prob(mean, log_std, action)  # (B,)
            name = "actor_loss" if i == 0 else f"actor_loss_beta{beta:g}"
            losses[name] = actor_loss(advantage_weight(advantage, beta), log_prob)
        monitors = {
            "q": qs.mean(),
            "v": v.mean(),
            "advantage": advantage.mean(),
            "weight": advantage_weight(advantage, self.betas[0]).mean(),
        }
        parts = {name: value.detach() for name, value in (losses | monitors).items()}
        return torch.stack(list(losses.values())).sum(), parts

    @torch.no_grad()
    def update_target(self) -> None:
        """Move the target critics towards the critics (Polyak averaging)."""
        for target, source in zip(self.target_critic.parameters(), self.critic.parameters(), strict=True):
            target.lerp_(source, self.target_rate)
