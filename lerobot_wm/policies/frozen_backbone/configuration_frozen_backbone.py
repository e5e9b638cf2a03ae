"""Configuration of a frozen image backbone as a LeRobot policy type."""

from dataclasses import dataclass, field
from typing import NoReturn

from lerobot.configs import NormalizationMode, PreTrainedConfig

from lerobot_wm.policies.features import IDENTITY_NORMALIZATION, image_keys

RGB_CHANNELS = 3


@dataclass
class BackboneConfig:
    """What a backbone's weights are to be loaded into; part of every checkpoint that holds one.

    Args:
        name: A classification model of torchvision, or `timm/NAME` for one of timm.
        image_size: Height and width that images are resized to.
        latent_dim: Number of its pooled features; filled when it is built.
    """

    name: str
    image_size: int
    latent_dim: int = 0


@PreTrainedConfig.register_subclass("frozen_backbone")
@dataclass
class FrozenBackboneConfig(PreTrainedConfig):
    """An image backbone in place of the world model: the control that tells what pretraining on the robot adds.

    It is not trained: `lerobot-wm init` writes its checkpoint, which `lerobot-wm encode` and
    `--policy.world_model_path` take as they take a world model's.

    Args:
        backbone: A classification model of torchvision (resnet18), or `timm/NAME` for one of timm.
        weights_path: A local file with its weights, safetensors or a torch state dict (torchvision's, R3M's);
            None leaves it at its random initialisation.
        backbone_image_size: Height and width that images are resized to; None takes the dataset's own size.
        image_key: The camera to encode; None takes the dataset's only camera.
    """

    backbone: str = "resnet18"
    weights_path: str | None = None
    backbone_image_size: int | None = None
    image_key: str | None = None
    normalization_mapping: dict[str, NormalizationMode] = field(
        default_factory=lambda: dict(IDENTITY_NORMALIZATION)
    )

    @property
    def observation_delta_indices(self) -> None:
        """Single frames."""
        return None

    @property
    def action_delta_indices(self) -> None:
        """Single frames."""
        return None

    @property
    def reward_delta_indices(self) -> None:
        """Single frames."""
        return None

    def validate_features(self) -> None:
        """Choose the camera and the image size.

        Raises:
            ValueError: No camera or several, or images that are not RGB.
        """
        cameras = image_keys(self.input_features)
        if self.image_key is None and len(cameras) == 1:
            self.image_key = cameras[0]
        if self.image_key not in cameras:
            raise ValueError(
                f"frozen_backbone encodes one camera; the dataset has {cameras or 'none'} and --policy.image_key is "
                f"{self.image_key!r}. Set --policy.image_key to one of the dataset's cameras."
            )
        channels, height, width = self.input_features[self.image_key].shape
        if channels != RGB_CHANNELS:
            raise ValueError(
                f"'{self.image_key}' has {channels} channels; backbones are made for RGB images."
            )
        if self.backbone_image_size is None:
            self.backbone_image_size = max(height, width)

    def get_optimizer_preset(self) -> NoReturn:
        """Refuse: nothing is trained.

        Raises:
            NotImplementedError: Always; says what writes the checkpoint.
        """
        raise NotImplementedError(
            "A frozen backbone is not trained. Write its checkpoint with "
            "`lerobot-wm init --policy.type=frozen_backbone --dataset.repo_id=... --output_dir=...`."
        )

    def get_scheduler_preset(self) -> None:
        """None: nothing is trained."""
        return None
