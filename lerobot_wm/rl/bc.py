"""Behaviour cloning: its loss, and a head that samples actions where demonstrations solve a task in several ways."""

import math
from collections.abc import Sequence

import torch
from torch import Tensor, nn

from lerobot_wm.nn.mlp import MLP

_TIME_FEATURES = 32
_STEPS = 10  # of Euler's method, from noise to actions


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


class FlowHead(nn.Module):
    """A velocity field that carries Gaussian noise to actions, given an observation (Lipman et al. 2023).

    Training draws a point x_τ = (1 - τ) x_0 + τ x_1 between noise x_0 and demonstrated actions x_1, and regresses
    x_1 - x_0 on it. The mean of the regression is taken over all pairs that pass through the point, so that the field
    splits where the demonstrations do; a mean squared error on actions would aim between them.

    Args:
        observation_dim: O.
        hidden_dims: Widths of the layers that read the observation; the first is also that of as many residual blocks.
        output_dim: Size of the sampled vector, N.
        dropout: Dropout of the layers that read the observation.
    """

    frequencies: Tensor

    def __init__(
        self, observation_dim: int, hidden_dims: Sequence[int], output_dim: int, dropout: float
    ) -> None:
        super().__init__()
        width = hidden_dims[0]
        self.observe = MLP(observation_dim, hidden_dims, width, nn.ReLU, dropout)
        self.enter = nn.Linear(output_dim + _TIME_FEATURES, width)
        self.blocks = nn.ModuleList(
            nn.Sequential(nn.LayerNorm(width), nn.Linear(width, width), nn.SiLU(), nn.Linear(width, width))
            for _ in hidden_dims
        )
        self.leave = nn.Linear(width, output_dim)
        nn.init.zeros_(self.leave.weight)
        frequencies = torch.logspace(0, math.log10(100), _TIME_FEATURES // 2)
        self.register_buffer("frequencies", frequencies, persistent=False)

    def velocity(self, features: Tensor, x: Tensor, tau: Tensor) -> Tensor:
        """The field (B, N) at points x (B, N) and times tau (B, 1), given `observe(observation)` (B, width)."""
        angles = tau * self.frequencies  # (B, _TIME_FEATURES / 2)
        hidden = features + self.enter(torch.cat([x, angles.sin(), angles.cos()], dim=-1))  # (B, width)
        for block in self.blocks:
            hidden = hidden + block(hidden)
        with torch.autocast(x.device.type, enabled=False):  # in float32, as MLP's last layer
            return self.leave(hidden.float())

    def errors(self, observation: Tensor, actions: Tensor) -> Tensor:
        """Squared errors (B, N) of the field at a random point of each sample, given actions (B, N)."""
        noise = torch.randn_like(actions)  # x_0
        tau = torch.rand(len(actions), 1, device=actions.device)  # (B, 1)
        point = torch.lerp(noise, actions, tau)
        velocity = self.velocity(self.observe(observation), point, tau)
        return (velocity - (actions - noise)).square()

    def forward(self, observation: Tensor, noise: Tensor) -> Tensor:
        """Actions (B, N) that the flow carries noise (B, N) to, given observations (B, O)."""
        features, x = self.observe(observation), noise
        for step in range(_STEPS):
            tau = x.new_full((len(x), 1), step / _STEPS)
            x = x + self.velocity(features, x, tau) / _STEPS
        return x
