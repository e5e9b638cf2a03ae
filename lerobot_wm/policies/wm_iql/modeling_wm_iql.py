"""Multi-task implicit Q-learning on world-model latents."""

from copy import deepcopy
from typing import Any

import torch
from lerobot.datasets.dataset_metadata import LeRobotDatasetMetadata
from torch import Tensor, nn

from lerobot_wm.constants import ACTION, DONE, OBS_LATENT, OBS_STATE, REWARD
from lerobot_wm.nn.mlp import MLP, orthogonal_init
from lerobot_wm.policies.latent_policy import LatentPolicy
from lerobot_wm.policies.wm_iql.configuration_wm_iql import WMIQLConfig
from lerobot_wm.rl import iql


class TwinCritic(nn.Module):
    """Two independent Q functions of (observation, action)."""

    def __init__(self, input_dim: int, hidden_dims: list[int]) -> None:
        super().__init__()
        self.critics = nn.ModuleList(MLP(input_dim, hidden_dims, 1, nn.ReLU) for _ in range(2))

    def forward(self, observation: Tensor, action: Tensor) -> Tensor:
        """Q values (2, B) for observations (B, O) and actions (B, A)."""
        x = torch.cat([observation, action], dim=-1)
        return torch.stack([critic(x).squeeze(-1) for critic in self.critics])


class WMIQLPolicy(LatentPolicy):
    """Actor N(tanh MLP, state-independent std), twin critics with Polyak targets, and a value function.

    All three losses of a step are taken at the same parameters and descended together: LeRobot's loop makes
    one backward pass and one optimizer step. The reference updates V before Q uses it; the lag is one step.
    """

    config_class = WMIQLConfig
    name = "wm_iql"

    def __init__(
        self,
        config: WMIQLConfig,
        dataset_stats: dict[str, dict[str, Any]] | None = None,
        dataset_meta: LeRobotDatasetMetadata | None = None,
    ) -> None:
        super().__init__(config, dataset_stats, dataset_meta)
        if dataset_meta is not None:
            missing = [key for key in (REWARD, DONE) if key not in dataset_meta.features]
            if missing:
                raise ValueError(
                    f"wm_iql learns from rewards, but {dataset_meta.repo_id} has no {' and no '.join(missing)}: add "
                    "them to the dataset, or train --policy.type=wm_bc, which needs none."
                )
        self.actor = MLP(
            config.observation_dim, config.hidden_dims, config.action_dim, nn.ReLU, config.dropout
        )
        self.log_std = nn.Parameter(torch.zeros(config.action_dim))
        self.critic = TwinCritic(config.observation_dim + config.action_dim, config.hidden_dims)
        self.value = MLP(config.observation_dim, config.hidden_dims, 1, nn.ReLU)
        for network in (self.actor, self.critic, self.value):
            orthogonal_init(network)
        self.target_critic = deepcopy(self.critic).requires_grad_(False)

    def get_optim_params(self) -> dict:
        """Three groups, the actor first: only its learning rate decays."""
        return [  # type: ignore[return-value]
            {"params": [*self.actor.parameters(), self.log_std]},
            {"params": list(self.critic.parameters())},
            {"params": list(self.value.parameters())},
        ]

    def actor_mean(self, observation: Tensor) -> Tensor:
        """Mean of the policy's Gaussian (B, A) for observations (B, O)."""
        return self.actor(observation).tanh()

    def forward(self, batch: dict[str, Any]) -> tuple[Tensor, dict[str, float]]:
        """Value, critic and actor losses on a batch of transitions.

        Args:
            batch: `observation.latent` (B, 2, D+S) and `observation.state` (B, 2, P) at t and t+1,
                `observation.state_is_pad` (B, 2), `action` (B, A), `next.reward` (B,), `next.done` (B,),
                `task` (B strings).

        Returns:
            The sum of the losses and its parts by name.
        """
        config = self.config
        states = batch[OBS_STATE]  # (B, 2, P)
        tasks = self.one_hot_tasks(batch, states.shape[0])  # (B, N)
        latents = batch[OBS_LATENT].unbind(1) if config.use_latent else (None, None)
        now = self.observation(states[:, 0], tasks, latents[0])  # (B, O)
        following = self.observation(states[:, 1], tasks, latents[1])  # (B, O)
        action = self.action_scaling(batch[ACTION])  # (B, A) in [-1, 1]
        terminal = batch[DONE].flatten()  # (B,)
        # The last frame of an episode has no successor: without success there it cannot be bootstrapped.
        has_target = terminal.bool() | ~batch[f"{OBS_STATE}_is_pad"][:, 1]

        with torch.no_grad():
            target_q = self.target_critic(now, action).amin(0)  # (B,)
            next_v = self.value(following).squeeze(-1)  # (B,)
        v = self.value(now).squeeze(-1)  # (B,)
        qs = self.critic(now, action)  # (2, B)
        target = iql.critic_target(batch[REWARD].flatten(), next_v, terminal, config.discount)
        advantage = target_q - v
        weight = iql.advantage_weight(advantage, config.beta)
        log_prob = iql.gaussian_log_prob(self.actor_mean(now), self.log_std, action)
        losses = {
            "value_loss": iql.value_loss(target_q, v, config.expectile),
            "critic_loss": iql.critic_loss(qs, target, has_target),
            "actor_loss": iql.actor_loss(weight, log_prob),
        }
        monitors = {"q": qs.mean(), "v": v.mean(), "advantage": advantage.mean(), "weight": weight.mean()}
        values = torch.stack([*losses.values(), *monitors.values()]).tolist()  # one transfer from the device
        return torch.stack(list(losses.values())).sum(), dict(zip([*losses, *monitors], values, strict=True))

    @torch.no_grad()
    def update(self) -> None:
        """Move the target critics towards the critics; LeRobot calls this after every optimizer step."""
        for target, source in zip(self.target_critic.parameters(), self.critic.parameters(), strict=True):
            target.lerp_(source, self.config.target_rate)
