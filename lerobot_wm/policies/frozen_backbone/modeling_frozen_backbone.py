"""A frozen image backbone as a LeRobot policy: a checkpoint that stands where a world model's stands."""

from typing import Any, NoReturn

from lerobot.datasets.dataset_metadata import LeRobotDatasetMetadata
from torch import Tensor

from lerobot_wm.policies.frozen_backbone.backbone import FrozenBackbone, load_backbone_weights
from lerobot_wm.policies.frozen_backbone.configuration_frozen_backbone import FrozenBackboneConfig
from lerobot_wm.policies.world_model.policy import WorldModelPolicy


class FrozenBackbonePolicy(WorldModelPolicy):
    """A backbone with a user's weights, or at its random initialisation; it has no training loss."""

    config_class = FrozenBackboneConfig
    name = "frozen_backbone"
    config: FrozenBackboneConfig
    world_model: FrozenBackbone

    def __init__(
        self,
        config: FrozenBackboneConfig,
        dataset_stats: dict[str, dict[str, Any]] | None = None,
        dataset_meta: LeRobotDatasetMetadata | None = None,
    ) -> None:
        super().__init__(config, dataset_stats, dataset_meta)
        assert config.backbone_image_size is not None  # chosen by validate_features
        self.world_model = FrozenBackbone(
            config.backbone, config.backbone_image_size, len(config.cameras), config.image_size
        )
        config.latent_dim = self.world_model.latent_dim
        is_new = dataset_meta is not None  # not loaded from a checkpoint, which has the weights in it
        if is_new and config.weights_path is not None:
            load_backbone_weights(self.world_model.model, config.weights_path)

    def get_optim_params(self) -> NoReturn:
        """Refuse: nothing is trained."""
        self.config.get_optimizer_preset()

    def forward(self, batch: dict[str, Tensor]) -> NoReturn:
        """Refuse: nothing is trained."""
        self.config.get_optimizer_preset()
