"""Multi-task behaviour cloning from pixels."""

from typing import Any

from lerobot.datasets.dataset_metadata import LeRobotDatasetMetadata
from torch import Tensor, nn

from lerobot_wm.constants import ACTION, OBS_STATE
from lerobot_wm.nn.mlp import MLP
from lerobot_wm.policies.common.cameras import camera_images
from lerobot_wm.policies.e2e.policy import E2EPolicy
from lerobot_wm.policies.e2e_bc.configuration_e2e_bc import E2EBCConfig
from lerobot_wm.rl.bc import bc_loss


class E2EBCPolicy(E2EPolicy):
    """An MLP from [image features, one-hot task, proprioception] to the action, trained with mean squared error."""

    config_class = E2EBCConfig
    name = "e2e_bc"
    config: E2EBCConfig

    def __init__(
        self,
        config: E2EBCConfig,
        dataset_stats: dict[str, dict[str, Any]] | None = None,
        dataset_meta: LeRobotDatasetMetadata | None = None,
    ) -> None:
        super().__init__(config, dataset_stats, dataset_meta)
        self.actor = MLP(self.observation_dim, config.hidden_dims, config.action_dim, nn.ReLU, config.dropout)

    def get_optim_params(self) -> dict:
        """Every parameter: encoder and actor are trained together."""
        return list(self.parameters())  # type: ignore[return-value]  # LeRobot's annotation is narrower than its use

    def heads(self) -> list[MLP]:
        """The actor."""
        return [self.actor]

    def actor_mean(self, observation: Tensor) -> Tensor:
        """The regressed action (B, A) for observations (B, O)."""
        return self.actor(observation)

    def forward(self, batch: dict[str, Any]) -> tuple[Tensor, dict[str, float]]:
        """Mean squared error on a batch of frames.

        Args:
            batch: Each camera (B, C, H, W) in [0, 1], `observation.state` (B, P), `action` (B, A), `task` (B strings).

        Returns:
            The scalar loss, and no parts: the loss is all there is.
        """
        state = batch[OBS_STATE]
        tasks = self.one_hot_tasks(batch, state.shape[0])  # (B, N)
        observation = self.observation(camera_images(self.config, batch), state, tasks)  # (B, O)
        return bc_loss(self.actor(observation), self.action_scaling(batch[ACTION])), {}
