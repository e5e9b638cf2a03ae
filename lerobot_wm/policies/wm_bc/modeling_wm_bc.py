"""Multi-task behaviour cloning on world-model latents."""

from typing import Any

from torch import Tensor, nn

from lerobot_wm.constants import ACTION, OBS_STATE
from lerobot_wm.nn.mlp import MLP
from lerobot_wm.policies.common.config import compiled
from lerobot_wm.policies.latent.policy import LatentPolicy
from lerobot_wm.policies.wm_bc.configuration_wm_bc import WMBCConfig
from lerobot_wm.rl.bc import bc_loss


class WMBCPolicy(LatentPolicy):
    """An MLP from [latent, one-hot task, proprioception] to the action, trained with mean squared error."""

    config_class = WMBCConfig
    name = "wm_bc"

    def __init__(self, config: WMBCConfig, *args: Any, **kwargs: Any) -> None:
        super().__init__(config, *args, **kwargs)
        self.actor = MLP(
            config.observation_dim, config.hidden_dims, config.action_dim, nn.ReLU, config.dropout
        )
        if config.compile_model:
            self.loss = compiled(self.loss)  # type: ignore[method-assign]

    def get_optim_params(self) -> dict:
        """The actor's parameters: the world model is frozen."""
        return list(self.actor.parameters())  # type: ignore[return-value]

    def heads(self) -> list[MLP]:
        """The actor."""
        return [self.actor]

    def actor_mean(self, observation: Tensor) -> Tensor:
        """The regressed action (B, A) for observations (B, O)."""
        return self.actor(observation)

    def training_inputs(self, batch: dict[str, Any]) -> tuple[Tensor, ...]:
        """What the loss is taken of.

        Args:
            batch: `observation.latent` (B, L), `observation.state` (B, P), `action` (B, A), `task` (B strings), and
                `observation.environment_state` (B, F) with `use_environment_state`.

        Returns:
            Observations (B, O) and scaled actions (B, A).
        """
        tasks = self.one_hot_tasks(batch, batch[OBS_STATE].shape[0])  # (B, N)
        return self.observation_at(batch, tasks), self.action_scaling(batch[ACTION])

    def loss(self, *inputs: Tensor) -> tuple[Tensor, dict[str, Tensor]]:
        """Mean squared error of frames, and no parts: the loss is all there is."""
        observation, action = inputs
        return bc_loss(self.actor(observation), action), {}
