"""Multi-task implicit Q-learning on world-model latents."""

from typing import Any

from torch import Tensor

from lerobot_wm.constants import ACTION
from lerobot_wm.policies.common.iql import IQLPolicy
from lerobot_wm.policies.latent.policy import LatentPolicy
from lerobot_wm.policies.wm_iql.configuration_wm_iql import WMIQLConfig


class WMIQLPolicy(IQLPolicy, LatentPolicy):
    """An IQL agent on [latent, one-hot task, proprioception]."""

    config_class = WMIQLConfig
    name = "wm_iql"
    config: WMIQLConfig  # type: ignore[assignment]

    def get_optim_params(self) -> dict:
        """The agent's three groups, the actors first: the world model is frozen."""
        return self.agent.param_groups()  # type: ignore[return-value]  # LeRobot's annotation is narrower than its use

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
        return self.agent.loss(
            now, following, self.scaled(batch[ACTION], self.state_at(batch, 0)), *self.rewards_and_ends(batch)
        )
