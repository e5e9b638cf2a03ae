"""Multi-task behaviour cloning on world-model latents."""

from typing import Any

from torch import Tensor

from lerobot_wm.policies.common.bc import BCPolicy
from lerobot_wm.policies.latent.policy import LatentPolicy
from lerobot_wm.policies.wm_bc.configuration_wm_bc import WMBCConfig


class WMBCPolicy(BCPolicy, LatentPolicy):
    """A head on [latent, one-hot task, proprioception], trained on demonstrated actions."""

    config_class = WMBCConfig
    name = "wm_bc"
    config: WMBCConfig  # type: ignore[assignment]

    def get_optim_params(self) -> dict:
        """The head's parameters: the world model is frozen."""
        return list(self.actor.parameters())  # type: ignore[return-value]  # LeRobot's annotation is narrower than its use

    def compute_loss(self, batch: dict[str, Any]) -> tuple[Tensor, dict[str, Tensor]]:
        """The head's error on a batch of frames.

        Args:
            batch: `observation.latent` (B, L), `observation.state` (B, P), `action` (B, A) or with chunks (B, K, A) and
                `action_is_pad` (B, K), `task` (B strings), and `observation.environment_state` (B, F) with
                `use_environment_state`.

        Returns:
            The scalar loss, which has no parts.
        """
        tasks = self.one_hot_tasks(batch, self.batch_size(batch))  # (B, N)
        return self.head_loss(self.observation_at(batch, tasks), batch), {}
