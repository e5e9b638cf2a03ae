"""What the configurations of the end-to-end policies share."""

from dataclasses import dataclass

from lerobot.datasets.dataset_metadata import LeRobotDatasetMetadata

from lerobot_wm.policies.common.acting_config import ActingConfig
from lerobot_wm.policies.common.features import policy_features

ENCODERS = ("small", "keypoints", "resnet18", "resnet34")


@dataclass
class E2EConfig(ActingConfig):
    """A policy trained from pixels, the baseline without a world model (paper section 3.2; PTR, Kumar et al. 2022).

    An image encoder (GroupNorm CNN, learned spatial embeddings) is trained together with the heads, which read
    [image features, one-hot task, proprioception].

    Args:
        encoder: "small" (four convolutions), "keypoints" (64 of them, for square images; as the world model's
            `n_keypoints`), "resnet18" or "resnet34" (PTR's), always trained from scratch.
        encoder_image_size: (H, W) that the images of all cameras are resized to, such as '[64,64]'; None takes that of
            the first camera. Time and memory grow with it.
        random_crop_pad: Largest random shift of training images, in pixels; 0 leaves them. PTR: 4.
    """

    encoder: str = "small"
    encoder_image_size: tuple[int, int] | None = None
    random_crop_pad: int = 0

    def __post_init__(self) -> None:
        super().__post_init__()
        if self.encoder not in ENCODERS:
            raise ValueError(f"--policy.encoder={self.encoder!r} is not one of {', '.join(ENCODERS)}.")
        if self.random_crop_pad < 0:
            raise ValueError(f"--policy.random_crop_pad={self.random_crop_pad}: expected pixels, 0 or more.")
        if self.compile_model:
            raise ValueError(
                f"--policy.compile_model=true: {self.type} has nothing to compile. Leave the flag out."
            )

    @property
    def image_size(self) -> tuple[int, int]:
        """(H, W) that the encoder takes."""
        return self.encoder_image_size or super().image_size

    def fill_from_dataset(self, dataset_meta: LeRobotDatasetMetadata) -> None:
        """Take the tasks and the cameras' sizes."""
        super().fill_from_dataset(dataset_meta)
        found = policy_features(dataset_meta)
        for key in self.input_features.keys() & found.keys():
            self.input_features[key] = found[key]

    def validate_features(self) -> None:
        """Choose the cameras and the image size; the inputs are then the cameras and proprioception.

        Raises:
            ValueError: The cameras cannot be used, keypoints get images that are not square, `state_keys` are not
                there, or there is no action.
        """
        self.choose_cameras()
        self.encoder_image_size = height, width = self.image_size
        if self.encoder == "keypoints" and height != width:
            raise ValueError(
                f"--policy.encoder=keypoints takes square images, but these are {height}x{width}: add "
                "--policy.encoder_image_size=[64,64]."
            )
        _ = self.state_dim, self.action_dim
        self.remove_inputs(self.input_features.keys() - {*self.cameras, *self.state_vectors})
