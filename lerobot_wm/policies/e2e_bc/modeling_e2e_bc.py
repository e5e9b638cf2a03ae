"""Multi-task behaviour cloning from pixels."""

from typing import Any

from torch import Tensor, nn

from lerobot_wm.nn.mlp import MLP
from lerobot_wm.policies.e2e.policy import E2EPolicy
from lerobot_wm.policies.e2e_bc.configuration_e2e_bc import E2EBCConfig
from lerobot_wm.rl.bc import bc_loss


class E2EBCPolicy(E2EPolicy):
    """An MLP from [image features, one-hot task, proprioception] to the action, trained with mean squared error."""

    config_class = E2EBCConfig
    name = "e2e_bc"
    config: E2EBCConfig

    def build(self) -> None:
        """Make the encoder and the actor."""
        super().build()
        config = self.config
        self.actor = MLP(self.observation_dim, config.hidden_dims, config.action_dim, nn.ReLU, config.dropout)

    def get_optim_params(self) -> dict:
        """Every parameter: encoder and actor are trained together."""
        return list(self.parameters())  # type: ignore[return-value]  # LeRobot's annotation is narrower than its use

    def observation_networks(self) -> list[MLP]:
        """The actor."""
        return [self.actor]

    def actor_mean(self, observation: Tensor) -> Tensor:
        """The regressed action (B, A) for observations (B, O)."""
        return self.actor(observation)

    def compute_loss(self, batch: dict[str, Any]) -> tuple[Tensor, dict[str, Tensor]]:
        """Mean squared error on a batch of frames.

        Args:
            batch: Each camera (B, C, H, W) in [0, 1], `observation.state` (B, P), `action` (B, A), `task` (B strings).

        Returns:
            The scalar loss, which has no parts.
        """
        state = self.state_at(batch)
        tasks = self.one_hot_tasks(batch, state.shape[0])  # (B, N)
        observation = self.observation(self.images(batch), state, tasks)  # (B, O)
        return bc_loss(self.actor(observation), self.scaled_actions(batch)), {}
