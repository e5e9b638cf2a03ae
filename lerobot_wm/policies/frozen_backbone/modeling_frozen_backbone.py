"""A frozen image backbone as a LeRobot policy: a checkpoint that stands where a world model's stands."""

from typing import Any, NoReturn

from lerobot.datasets.dataset_metadata import LeRobotDatasetMetadata
from torch import Tensor

from lerobot_wm.policies.frozen_backbone.backbone import FrozenBackbone
from lerobot_wm.policies.frozen_backbone.configuration_frozen_backbone import (
    BackboneConfig,
    FrozenBackboneConfig,
)
from lerobot_wm.policies.frozen_backbone.weights import load_backbone_weights
from lerobot_wm.policies.pretrained import StrictPolicy


class FrozenBackbonePolicy(StrictPolicy):
    """A backbone with a user's weights, or at its random initialisation.

    It has neither loss nor actions: `wm_bc` and `wm_iql` act on its features.
    """

    config_class = FrozenBackboneConfig
    name = "frozen_backbone"
    config: FrozenBackboneConfig

    def __init__(
        self,
        config: FrozenBackboneConfig,
        dataset_stats: dict[str, dict[str, Any]] | None = None,
        dataset_meta: LeRobotDatasetMetadata | None = None,
    ) -> None:
        super().__init__(config)
        config.validate_features()
        assert config.backbone_image_size is not None  # chosen by validate_features
        # Under the name of what it stands in for, so that encoding and latent policies treat both alike.
        self.world_model = FrozenBackbone(
            BackboneConfig(config.backbone, config.backbone_image_size, len(config.cameras))
        )
        is_new = dataset_meta is not None  # not loaded from a checkpoint, which has the weights in it
        if is_new and config.weights_path is not None:
            load_backbone_weights(self.world_model.model, config.weights_path)

    def get_optim_params(self) -> NoReturn:
        """Refuse: nothing is trained."""
        self.config.get_optimizer_preset()

    def forward(self, batch: dict[str, Tensor]) -> NoReturn:
        """Refuse: nothing is trained."""
        self.config.get_optimizer_preset()

    def reset(self) -> None:
        """Nothing to reset: features depend on one image."""

    def select_action(self, batch: dict[str, Tensor], **kwargs: Any) -> NoReturn:
        """Refuse: a backbone has no policy.

        Raises:
            NotImplementedError: Always; says which policy types act.
        """
        raise NotImplementedError(
            "frozen_backbone encodes images and chooses no actions. Train a policy on its features: "
            "lerobot-wm train --policy.type=wm_bc (or wm_iql) --policy.world_model_path=<this checkpoint>."
        )

    def predict_action_chunk(self, batch: dict[str, Tensor], **kwargs: Any) -> NoReturn:
        """Refuse, as `select_action` does."""
        self.select_action(batch)
