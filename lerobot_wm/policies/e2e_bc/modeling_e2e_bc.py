"""Multi-task behaviour cloning from pixels."""

from typing import Any

from torch import Tensor

from lerobot_wm.policies.common.bc import BCPolicy
from lerobot_wm.policies.e2e.policy import E2EPolicy
from lerobot_wm.policies.e2e_bc.configuration_e2e_bc import E2EBCConfig


class E2EBCPolicy(BCPolicy, E2EPolicy):
    """An encoder and a head on [image features, one-hot task, proprioception], trained on demonstrated actions."""

    config_class = E2EBCConfig
    name = "e2e_bc"
    config: E2EBCConfig  # type: ignore[assignment]

    def get_optim_params(self) -> dict:
        """Every parameter: encoder and head are trained together."""
        return list(self.parameters())  # type: ignore[return-value]  # LeRobot's annotation is narrower than its use

    def compute_loss(self, batch: dict[str, Any]) -> tuple[Tensor, dict[str, Tensor]]:
        """The head's error on a batch of frames.

        Args:
            batch: Each camera (B, C, H, W) in [0, 1], `observation.state` (B, P), `action` (B, A) or with chunks
                (B, K, A) and `action_is_pad` (B, K), `task` (B strings).

        Returns:
            The scalar loss, which has no parts.
        """
        state = self.state_at(batch)
        tasks = self.one_hot_tasks(batch, state.shape[0])  # (B, N)
        return self.head_loss(self.observation(self.images(batch), state, tasks), batch), {}
