"""A world model, or an encoder in its place, as a LeRobot policy type."""

from typing import Any, NoReturn

from torch import Tensor

from lerobot_wm.policies.common.policy import BasePolicy
from lerobot_wm.policies.world_model.config import WorldModelConfig
from lerobot_wm.world_model.interface import LatentModel


class WorldModelPolicy(BasePolicy):
    """Base of the types that make latents and choose no actions: `wm_bc` and `wm_iql` act on them.

    `build` of a subclass sets `world_model`, and `compute_loss` is its training loss. A policy on the latents holds
    that module; what else a subclass has (decoders, targets) only serves training.
    """

    config_class = WorldModelConfig
    name = "world_model"
    config: WorldModelConfig
    world_model: LatentModel

    def get_optim_params(self) -> dict:
        """Every parameter."""
        return list(self.parameters())  # type: ignore[return-value]  # LeRobot's annotation is narrower than its use

    def reset(self) -> None:
        """Nothing to reset: no recurrent state is kept between calls."""

    def select_action(self, batch: dict[str, Tensor], **kwargs: Any) -> NoReturn:
        """Refuse: there is no policy.

        Raises:
            NotImplementedError: Always; says which policy types act.
        """
        raise NotImplementedError(
            f"{self.name} makes latents and chooses no actions. Train a policy on them: "
            "lerobot-wm train --policy.type=wm_bc (or wm_iql) --policy.world_model_path=<this checkpoint>."
        )

    def predict_action_chunk(self, batch: dict[str, Tensor], **kwargs: Any) -> NoReturn:
        """Refuse, as `select_action` does."""
        self.select_action(batch)
