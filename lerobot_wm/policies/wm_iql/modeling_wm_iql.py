"""Multi-task implicit Q-learning on world-model latents."""

from typing import Any

from lerobot.datasets.dataset_metadata import LeRobotDatasetMetadata
from torch import Tensor

from lerobot_wm.nn.mlp import MLP
from lerobot_wm.policies.common.config import compiled
from lerobot_wm.policies.common.iql import RewardsAndEnds, make_agent
from lerobot_wm.policies.latent.policy import LatentPolicy
from lerobot_wm.policies.wm_iql.configuration_wm_iql import WMIQLConfig


class WMIQLPolicy(LatentPolicy):
    """An IQL agent on [latent, one-hot task, proprioception]."""

    config_class = WMIQLConfig
    name = "wm_iql"
    config: WMIQLConfig

    def build(self) -> None:
        """Make the world model and the agent."""
        super().build()
        config = self.config
        self.agent = make_agent(
            config.iql, config.observation_dim, config.action_dim, config.hidden_dims, config.dropout
        )
        self.rewards_and_ends = RewardsAndEnds(config)

    def prepare_training(self, dataset_meta: LeRobotDatasetMetadata) -> None:
        """Read rewards and ends from the dataset's columns; compile the loss, with `compile_model`."""
        config = self.config
        self.rewards_and_ends = RewardsAndEnds(config, dataset_meta)
        if config.compile_model:
            self.agent.loss = compiled(self.agent.loss)  # type: ignore[method-assign]

    def get_optim_params(self) -> dict:
        """The agent's three groups, the actors first: the world model is frozen."""
        return self.agent.param_groups()  # type: ignore[return-value]  # LeRobot's annotation is narrower than its use

    def observation_networks(self) -> list[MLP]:
        """The agent's networks."""
        return self.agent.networks()

    def actor_chunk(self, observation: Tensor, batch: dict[str, Any] | None = None) -> Tensor:
        """Mean of the policy's Gaussian (B, 1, A) for observations (B, O)."""
        return self.agent.mean_action(observation, self.config.iql.beta)[:, None]

    def compute_loss(self, batch: dict[str, Any]) -> tuple[Tensor, dict[str, Tensor]]:
        """Value, critic and actor losses on a batch of transitions.

        Args:
            batch: `observation.latent` (B, 2, L) and `observation.state` (B, 2, P) at t and t+1,
                `observation.state_is_pad` (B, 2), `action` (B, A), `next.reward` and `next.done` (B,) or `index` (B,),
                `task` (B strings), and `observation.environment_state` (B, 2, F) with `use_environment_state`.

        Returns:
            The sum of the losses, and its parts by name.
        """
        tasks = self.one_hot_tasks(batch, self.batch_size(batch))  # (B, N)
        now, following = (self.observation_at(batch, tasks, t) for t in (0, 1))  # (B, O) each
        return self.agent.loss(now, following, self.scaled_actions(batch), *self.rewards_and_ends(batch))

    def update(self) -> None:
        """Move the target critics; LeRobot calls this after every optimizer step."""
        self.agent.update_target()
