"""Multi-task behaviour cloning on world-model latents."""

from typing import Any

from lerobot.datasets.dataset_metadata import LeRobotDatasetMetadata
from torch import Tensor, nn

from lerobot_wm.nn.mlp import MLP
from lerobot_wm.policies.common.config import compiled
from lerobot_wm.policies.latent.policy import LatentPolicy
from lerobot_wm.policies.wm_bc.configuration_wm_bc import WMBCConfig
from lerobot_wm.rl.bc import bc_loss


class WMBCPolicy(LatentPolicy):
    """An MLP from [latent, one-hot task, proprioception] to the action, trained with mean squared error."""

    config_class = WMBCConfig
    name = "wm_bc"
    config: WMBCConfig

    def build(self) -> None:
        """Make the world model and the actor."""
        super().build()
        config = self.config
        self.actor = MLP(
            config.observation_dim, config.hidden_dims, config.action_dim, nn.ReLU, config.dropout
        )

    def prepare_training(self, dataset_meta: LeRobotDatasetMetadata) -> None:
        """Compile the loss, with `compile_model`."""
        if self.config.compile_model:
            self.loss = compiled(self.loss)  # type: ignore[method-assign]

    def get_optim_params(self) -> dict:
        """The actor's parameters: the world model is frozen."""
        return list(self.actor.parameters())  # type: ignore[return-value]  # LeRobot's annotation is narrower than its use

    def observation_networks(self) -> list[MLP]:
        """The actor."""
        return [self.actor]

    def actor_mean(self, observation: Tensor) -> Tensor:
        """The regressed action (B, A) for observations (B, O)."""
        return self.actor(observation)

    def compute_loss(self, batch: dict[str, Any]) -> tuple[Tensor, dict[str, Tensor]]:
        """Mean squared error on a batch of frames.

        Args:
            batch: `observation.latent` (B, L), `observation.state` (B, P), `action` (B, A), `task` (B strings), and
                `observation.environment_state` (B, F) with `use_environment_state`.

        Returns:
            The scalar loss, which has no parts.
        """
        tasks = self.one_hot_tasks(batch, self.batch_size(batch))  # (B, N)
        return self.loss(self.observation_at(batch, tasks), self.scaled_actions(batch)), {}

    def loss(self, observation: Tensor, action: Tensor) -> Tensor:
        """Mean squared error of the actions on observations (B, O), given scaled actions (B, A)."""
        return bc_loss(self.actor(observation), action)
