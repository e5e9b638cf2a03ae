"""What the configurations of the end-to-end policies share."""

from dataclasses import dataclass

from lerobot_wm.policies.features import image_keys
from lerobot_wm.policies.multi_task_config import MultiTaskConfig

ENCODERS = ("small", "resnet18", "resnet34")


@dataclass
class E2EConfig(MultiTaskConfig):
    """A policy trained from pixels, the baseline without a world model (paper section 3.2; PTR, Kumar et al. 2022).

    An image encoder (GroupNorm CNN, learned spatial embeddings) is trained together with the heads, which read
    [image features, one-hot task, proprioception].

    Args:
        encoder: "small" (four convolutions), "resnet18" or "resnet34" (PTR's), always trained from scratch.
        image_key: The camera the policy sees; None takes the dataset's only camera.
        random_crop_pad: Training images are shifted at random by up to this many pixels; 0 leaves them. PTR: 4.
    """

    encoder: str = "small"
    image_key: str | None = None
    random_crop_pad: int = 0

    def __post_init__(self) -> None:
        super().__post_init__()
        if self.encoder not in ENCODERS:
            raise ValueError(f"--policy.encoder={self.encoder!r} is not one of {', '.join(ENCODERS)}.")
        if self.random_crop_pad < 0:
            raise ValueError(f"--policy.random_crop_pad is {self.random_crop_pad}; it is pixels, 0 or more.")

    @property
    def camera(self) -> str:
        """The key of the camera's images; `validate_features` has chosen it."""
        assert self.image_key is not None
        return self.image_key

    @property
    def image_shape(self) -> tuple[int, int, int]:
        """(C, H, W) of the camera's images."""
        channels, height, width = self.input_features[self.camera].shape
        return channels, height, width

    def validate_features(self) -> None:
        """Choose the camera.

        Raises:
            ValueError: No camera or several, no proprioception, or no action.
        """
        cameras = image_keys(self.input_features)
        if self.image_key is None and len(cameras) == 1:
            self.image_key = cameras[0]
        if self.image_key not in cameras:
            raise ValueError(
                f"{self.type} sees one camera; the dataset has {cameras or 'none'} and --policy.image_key is "
                f"{self.image_key!r}. Set --policy.image_key to one of the dataset's cameras."
            )
        _ = self.state_dim, self.action_dim
