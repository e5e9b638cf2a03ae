"""Configuration of a frozen image backbone as a LeRobot policy type."""

from dataclasses import dataclass
from typing import NoReturn

from lerobot.configs import PreTrainedConfig

from lerobot_wm.policies.world_model.config import WorldModelConfig

RGB_CHANNELS = 3


@PreTrainedConfig.register_subclass("frozen_backbone")
@dataclass
class FrozenBackboneConfig(WorldModelConfig):
    """An image backbone in place of the world model: the control that shows what pretraining on the robot adds.

    It is not trained. `lerobot-wm init` writes its checkpoint, which `lerobot-wm encode` and
    `--policy.world_model_path` take as they take a world model's.

    Args:
        backbone: A classification model of torchvision (resnet18), or `timm/NAME` for one of timm.
        weights_path: A local file with its weights, safetensors or a torch state dict (torchvision's, R3M's);
            None keeps the random initialisation.
        backbone_image_size: Height and width that images are resized to; None takes the first camera's size.
        latent_dim: Number of pooled features of all cameras together; filled when the policy is created.
    """

    backbone: str = "resnet18"
    weights_path: str | None = None
    backbone_image_size: int | None = None
    latent_dim: int = 0

    @property
    def action_dim(self) -> None:
        """None: features depend on one image."""
        return None

    @property
    def features_read(self) -> list[str]:
        """Cameras alone."""
        return self.cameras

    def validate_features(self) -> None:
        """Choose the cameras and the image size.

        Raises:
            ValueError: The cameras cannot be used, or their images are not RGB.
        """
        super().validate_features()
        for key in self.cameras:
            channels = self.input_features[key].shape[0]
            if channels != RGB_CHANNELS:
                raise ValueError(f"'{key}' has {channels} channels; backbones take RGB images.")
        if self.backbone_image_size is None:
            self.backbone_image_size = max(self.image_size)

    def get_optimizer_preset(self) -> NoReturn:
        """Refuse: nothing is trained.

        Raises:
            NotImplementedError: Always; says what writes the checkpoint.
        """
        raise NotImplementedError(
            "A frozen backbone is not trained. Write its checkpoint with "
            "`lerobot-wm init --policy.type=frozen_backbone --dataset.repo_id=... --output_dir=...`."
        )
