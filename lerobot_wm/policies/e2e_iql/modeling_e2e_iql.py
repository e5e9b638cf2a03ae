"""Multi-task implicit Q-learning from pixels."""

from typing import Any

import torch
from lerobot.datasets.dataset_metadata import LeRobotDatasetMetadata
from torch import Tensor

from lerobot_wm.constants import ACTION, OBS_STATE
from lerobot_wm.nn.mlp import MLP
from lerobot_wm.policies.common.cameras import camera_images
from lerobot_wm.policies.common.features import logged
from lerobot_wm.policies.common.iql_agent import Outcomes, make_agent
from lerobot_wm.policies.e2e.policy import E2EPolicy
from lerobot_wm.policies.e2e_iql.configuration_e2e_iql import E2EIQLConfig


class E2EIQLPolicy(E2EPolicy):
    """An IQL agent on [image features, one-hot task, proprioception].

    One image encoder serves actor, critics and value, and is trained by their three losses. What is not descended,
    V(s') and the target critics, reads the same encoder without gradient.
    """

    config_class = E2EIQLConfig
    name = "e2e_iql"
    config: E2EIQLConfig

    def __init__(
        self,
        config: E2EIQLConfig,
        dataset_stats: dict[str, dict[str, Any]] | None = None,
        dataset_meta: LeRobotDatasetMetadata | None = None,
    ) -> None:
        super().__init__(config, dataset_stats, dataset_meta)
        self.agent = make_agent(config, self.observation_dim, anew=dataset_stats is not None)
        self.outcomes = Outcomes(config, dataset_meta)

    def get_optim_params(self) -> dict:
        """The agent's three groups, the actors first, and the encoder's, at a constant rate."""
        encoder = {"params": list(self.encoder.parameters())}
        return [*self.agent.param_groups(), encoder]  # type: ignore[return-value]

    def heads(self) -> list[MLP]:
        """The agent's networks."""
        return self.agent.networks()

    def actor_mean(self, observation: Tensor) -> Tensor:
        """Mean of the policy's Gaussian (B, A) for observations (B, O)."""
        return self.agent.mean_action(observation, self.config.beta)

    def forward(self, batch: dict[str, Any]) -> tuple[Tensor, dict[str, float]]:
        """Value, critic and actor losses on a batch of transitions.

        Args:
            batch: Each camera (B, 2, C, H, W) in [0, 1] and `observation.state` (B, 2, P) at t and t+1,
                `observation.state_is_pad` (B, 2), `action` (B, A), `next.reward` and `next.done` (B,) or `index` (B,),
                `task` (B strings).

        Returns:
            The sum of the losses and its parts by name.
        """
        images, states = camera_images(self.config, batch), batch[OBS_STATE]  # (B, 2, C, H, W), (B, 2, P)
        tasks = self.one_hot_tasks(batch, states.shape[0])  # (B, N)
        now = self.observation(images[:, 0], states[:, 0], tasks)  # (B, O)
        with torch.no_grad():
            following = self.observation(images[:, 1], states[:, 1], tasks)  # (B, O)
        action = self.action_scaling(batch[ACTION])  # (B, A)
        loss, parts = self.agent.loss(now, following, action, *self.outcomes(batch))
        return loss, logged(parts)

    def update(self) -> None:
        """Move the target critics; LeRobot calls this after every optimizer step."""
        self.agent.update_target()
