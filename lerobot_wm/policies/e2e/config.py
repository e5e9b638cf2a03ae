"""What the configurations of the end-to-end policies share."""

from dataclasses import dataclass

from lerobot_wm.policies.common.cameras import ImagePolicyConfig
from lerobot_wm.policies.common.multi_task_config import MultiTaskConfig

ENCODERS = ("small", "resnet18", "resnet34")


@dataclass
class E2EConfig(ImagePolicyConfig, MultiTaskConfig):
    """A policy trained from pixels, the baseline without a world model (paper section 3.2; PTR, Kumar et al. 2022).

    An image encoder (GroupNorm CNN, learned spatial embeddings) is trained together with the heads, which read
    [image features, one-hot task, proprioception].

    Args:
        encoder: "small" (four convolutions), "resnet18" or "resnet34" (PTR's), always trained from scratch.
        encoder_image_size: (H, W) that the images of all cameras are resized to, such as '[64,64]'; None takes that of
            the first camera. Time and memory grow with it.
        random_crop_pad: Training images are shifted at random by up to this many pixels; 0 leaves them. PTR: 4.
    """

    encoder: str = "small"
    encoder_image_size: tuple[int, int] | None = None
    random_crop_pad: int = 0

    def __post_init__(self) -> None:
        super().__post_init__()
        if self.encoder not in ENCODERS:
            raise ValueError(f"--policy.encoder={self.encoder!r} is not one of {', '.join(ENCODERS)}.")
        if self.random_crop_pad < 0:
            raise ValueError(f"--policy.random_crop_pad is {self.random_crop_pad}; it is pixels, 0 or more.")
        if self.encoder_image_size is None and self.cameras and self.input_features:
            self.encoder_image_size = self.image_size  # of a checkpoint from before this was noted

    @property
    def image_size(self) -> tuple[int, int]:
        """(H, W) that the encoder takes."""
        return self.encoder_image_size or super().image_size

    def validate_features(self) -> None:
        """Choose the cameras and the image size.

        Raises:
            ValueError: The cameras cannot be used, or there is no proprioception or no action.
        """
        self.choose_cameras()
        self.encoder_image_size = self.image_size
        _ = self.state_dim, self.action_dim
