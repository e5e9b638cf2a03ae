"""Multi-task implicit Q-learning from pixels."""

from typing import Any

import torch
from torch import Tensor

from lerobot_wm.constants import ACTION
from lerobot_wm.policies.common.iql import IQLPolicy
from lerobot_wm.policies.e2e.policy import E2EPolicy
from lerobot_wm.policies.e2e_iql.configuration_e2e_iql import E2EIQLConfig


class E2EIQLPolicy(IQLPolicy, E2EPolicy):
    """An IQL agent on [image features, one-hot task, proprioception].

    One image encoder serves actor, critics and value, and is trained by their three losses. V(s') and the target
    critics read the same encoder without gradient.
    """

    config_class = E2EIQLConfig
    name = "e2e_iql"
    config: E2EIQLConfig  # type: ignore[assignment]

    def get_optim_params(self) -> dict:
        """The agent's three groups, the actors first, and the encoder's, at a constant rate."""
        encoder = {"params": list(self.encoder.parameters())}
        return [*self.agent.param_groups(), encoder]  # type: ignore[return-value]

    def compute_loss(self, batch: dict[str, Any]) -> tuple[Tensor, dict[str, Tensor]]:
        """Value, critic and actor losses on a batch of transitions.

        Args:
            batch: Each camera (B, 2, C, H, W) in [0, 1] and `observation.state` (B, 2, P) at t and t+1,
                `observation.state_is_pad` (B, 2), `action` (B, A), `next.reward` and `next.done` (B,) or `index` (B,),
                `task` (B strings).

        Returns:
            The sum of the losses, and its parts by name.
        """
        images = self.images(batch)  # (B, 2, C, H, W)
        tasks = self.one_hot_tasks(batch, len(images))  # (B, N)
        now = self.observation(images[:, 0], self.state_at(batch, 0), tasks)  # (B, O)
        with torch.no_grad():
            following = self.observation(images[:, 1], self.state_at(batch, 1), tasks)  # (B, O)
        action = self.scaled(batch[ACTION], self.state_at(batch, 0))  # (B, A)
        return self.agent.loss(now, following, action, *self.rewards_and_ends(batch))
