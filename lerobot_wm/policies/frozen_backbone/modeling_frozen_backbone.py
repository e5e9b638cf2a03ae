"""A frozen image backbone as a LeRobot policy: its checkpoint stands in for a world model's."""

from typing import Any, NoReturn

from lerobot.datasets.dataset_metadata import LeRobotDatasetMetadata

from lerobot_wm.policies.common.policy import Statistics
from lerobot_wm.policies.frozen_backbone.backbone import FrozenBackbone, load_backbone_weights
from lerobot_wm.policies.frozen_backbone.configuration_frozen_backbone import FrozenBackboneConfig
from lerobot_wm.policies.world_model.policy import WorldModelPolicy


class FrozenBackbonePolicy(WorldModelPolicy):
    """A backbone with a user's weights, or with its random initialisation; it has no training loss."""

    config_class = FrozenBackboneConfig
    name = "frozen_backbone"
    config: FrozenBackboneConfig
    world_model: FrozenBackbone

    def build(self) -> None:
        """Make the backbone."""
        config = self.config
        assert config.backbone_image_size is not None  # chosen by validate_features
        self.world_model = FrozenBackbone(
            config.backbone, config.backbone_image_size, len(config.cameras), config.image_size
        )
        config.latent_dim = self.world_model.latent_dim

    def fit_dataset(self, stats: Statistics, dataset_meta: LeRobotDatasetMetadata) -> None:
        """Load the user's weights; later they are in the checkpoint."""
        if self.config.weights_path is not None:
            load_backbone_weights(self.world_model.model, self.config.weights_path)

    def get_optim_params(self) -> NoReturn:
        """Refuse: nothing is trained."""
        self.config.get_optimizer_preset()

    def compute_loss(self, batch: dict[str, Any]) -> NoReturn:
        """Refuse: nothing is trained."""
        self.config.get_optimizer_preset()
