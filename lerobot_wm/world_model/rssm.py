"""The recurrent state-space model: d_t = GRU(d_{t-1}, z_{t-1}, a_{t-1}), z_t ~ prior(d_t) or posterior(d_t, e_t).

Layers follow TorchRL's Dreamer (the paper's base), itself Dreamer V1 (Hafner et al. 2019):
prior Linear(z+a → H) ELU → GRU → Linear ELU → Linear(2S); posterior Linear(d+e → H) ELU → Linear(2S);
std = max(softplus(·), min_std). With keypoints the posterior's mean is Linear(e), so that z tells in the same way at
every place where things are; its std is as above.
"""

from dataclasses import dataclass

import torch
from torch import Tensor, nn
from torch.nn import functional as F

from lerobot_wm.world_model.config import RSSMConfig


@dataclass
class RSSMState:
    """A latent state or a sequence of them.

    Attributes:
        deter: d, (B, D) for one step or (B, T, D) for a sequence.
        stoch: z, (B, S) or (B, T, S).
    """

    deter: Tensor
    stoch: Tensor

    @property
    def latent(self) -> Tensor:
        """s = [d, z], (B, D+S) or (B, T, D+S)."""
        return torch.cat([self.deter, self.stoch], dim=-1)

    def last(self) -> "RSSMState":
        """The final step of a sequence, (B, ·)."""
        return RSSMState(self.deter[:, -1], self.stoch[:, -1])


@dataclass
class DiagonalNormal:
    """A diagonal Gaussian; mean and std are (..., S)."""

    mean: Tensor
    std: Tensor

    def kl(self, other: "DiagonalNormal") -> Tensor:
        """KL(self || other) in nats, summed over S: (...,)."""
        variance_ratio = (self.std / other.std).square()
        distance = ((self.mean - other.mean) / other.std).square()
        return 0.5 * (variance_ratio + distance - 1 - variance_ratio.log()).sum(-1)


class RSSM(nn.Module):
    """Deterministic path, prior and posterior. It all runs in float32, at a few percent of the training time."""

    def __init__(self, config: RSSMConfig, embed_dim: int) -> None:
        super().__init__()
        hidden, deter, stoch = config.hidden_dim, config.deter_dim, config.stoch_dim
        self.deter_dim, self.stoch_dim, self.min_std = deter, stoch, config.min_std
        self.recurrent_input = nn.Linear(stoch + config.action_dim, hidden)
        self.gru = nn.GRUCell(hidden, deter)
        self.prior_hidden = nn.Linear(deter, hidden)
        self.prior_params = nn.Linear(hidden, 2 * stoch)
        self.posterior_hidden = nn.Linear(deter + embed_dim, hidden)
        self.posterior_params = nn.Linear(hidden, stoch if config.n_keypoints else 2 * stoch)
        self.posterior_mean = nn.Linear(embed_dim, stoch) if config.n_keypoints else None

    def initial_state(self, batch_size: int) -> RSSMState:
        """Make the all-zero state from which every sequence starts, (B, ·)."""
        zeros = self.prior_params.weight.new_zeros
        return RSSMState(zeros(batch_size, self.deter_dim), zeros(batch_size, self.stoch_dim))

    def observe(
        self, embeds: Tensor, prev_actions: Tensor, state: RSSMState, *, sample: bool
    ) -> tuple[RSSMState, DiagonalNormal]:
        """Filter a sequence: compute the posterior state of each step from the images and actions up to it.

        Args:
            embeds: Image embeddings e_t, (B, T, E).
            prev_actions: a_{t-1} at position t, (B, T, A).
            state: s before the first step, (B, ·).
            sample: Draw z_t from the posterior (training) or take its mean (filtering).

        Returns:
            The states (B, T, ·) and the posterior of each step, (B, T, S).
        """
        with torch.autocast(embeds.device.type, enabled=False):
            # What does not depend on the recurrence is computed for all T at once.
            from_action = self._action_input(prev_actions)  # (B, T, H)
            d_weight, e_weight = self.posterior_hidden.weight.split([self.deter_dim, embeds.shape[-1]], 1)
            from_embed = F.linear(embeds.float(), e_weight, self.posterior_hidden.bias)  # (B, T, H)
            linear = None if self.posterior_mean is None else self.posterior_mean(embeds.float())  # (B, T, S)

            d, z = state.deter, state.stoch
            deters, stochs, means, stds = [], [], [], []
            for t, (step_action, step_embed) in enumerate(
                zip(from_action.unbind(1), from_embed.unbind(1), strict=True)
            ):
                d = self._advance(d, z, step_action)  # (B, D)
                hidden = F.elu(F.linear(d, d_weight) + step_embed)  # (B, H)
                params = self.posterior_params(hidden)  # (B, 2S), with keypoints (B, S)
                mean, raw_std = params.chunk(2, dim=-1) if linear is None else (linear[:, t], params)
                posterior = self._normal(mean, raw_std)
                z = posterior.mean
                if sample:
                    z = z + posterior.std * torch.randn_like(posterior.std)
                deters.append(d)
                stochs.append(z)
                means.append(posterior.mean)
                stds.append(posterior.std)
            states = RSSMState(torch.stack(deters, 1), torch.stack(stochs, 1))
            return states, DiagonalNormal(torch.stack(means, 1), torch.stack(stds, 1))

    def prior(self, deter: Tensor) -> DiagonalNormal:
        """Predict the distribution of z_t before o_t is seen; deter is d_t, (..., D)."""
        with torch.autocast(deter.device.type, enabled=False):
            return self._normal(*self.prior_params(F.elu(self.prior_hidden(deter))).chunk(2, dim=-1))

    def imagine(self, state: RSSMState, actions: Tensor) -> RSSMState:
        """Roll the prior forward without images; z_t is the prior's mean.

        Args:
            state: s_t, (B, ·).
            actions: a_t, a_{t+1}, ..., (B, H, A): the first is the one executed in `state`.

        Returns:
            s_{t+1} ... s_{t+H}, (B, H, ·).
        """
        d, z = state.deter, state.stoch
        deters, stochs = [], []
        with torch.autocast(actions.device.type, enabled=False):
            for step_action in self._action_input(actions).unbind(1):
                d = self._advance(d, z, step_action)  # (B, D)
                z = self.prior(d).mean  # (B, S)
                deters.append(d)
                stochs.append(z)
        return RSSMState(torch.stack(deters, 1), torch.stack(stochs, 1))

    def _action_input(self, actions: Tensor) -> Tensor:
        """Project actions (B, T, A) to their part of the GRU's input, (B, T, H)."""
        a_weight = self.recurrent_input.weight[:, self.stoch_dim :]  # (H, A)
        return F.linear(actions.float(), a_weight, self.recurrent_input.bias)

    def _advance(self, deter: Tensor, stoch: Tensor, from_action: Tensor) -> Tensor:
        """Compute d_t (B, D) from d_{t-1} (B, D), z_{t-1} (B, S) and the projected a_{t-1} (B, H)."""
        z_weight = self.recurrent_input.weight[:, : self.stoch_dim]  # (H, S)
        return self.gru(F.elu(F.linear(stoch, z_weight) + from_action), deter)

    def _normal(self, mean: Tensor, raw_std: Tensor) -> DiagonalNormal:
        return DiagonalNormal(mean, F.softplus(raw_std).clamp(min=self.min_std))
