"""What the configurations of the end-to-end policies share."""

from dataclasses import dataclass, field

from lerobot.datasets.dataset_metadata import LeRobotDatasetMetadata
from lerobot.utils.feature_utils import dataset_to_policy_features

from lerobot_wm.constants import ACTION, OBS_STATE
from lerobot_wm.policies.common.config import PolicyConfig, check_acting, feature_dim, task_names

ENCODERS = ("small", "resnet18", "resnet34")


@dataclass
class E2EConfig(PolicyConfig):
    """A policy trained from pixels, the baseline without a world model (paper section 3.2; PTR, Kumar et al. 2022).

    An image encoder (GroupNorm CNN, learned spatial embeddings) is trained together with the heads, which read
    [image features, one-hot task, proprioception].

    Args:
        hidden_dims: Widths of the hidden layers of every head.
        dropout: Dropout of the actor.
        action_noise: Standard deviation of Gaussian noise on the actions at test time, where the dataset's actions span
            [-1, 1]. It frees a policy that hovers in a place where no demonstration ends.
        tasks: Task strings in one-hot order, taken from the dataset when the policy is created.
        encoder: "small" (four convolutions), "resnet18" or "resnet34" (PTR's), always trained from scratch.
        encoder_image_size: (H, W) that the images of all cameras are resized to, such as '[64,64]'; None takes that of
            the first camera. Time and memory grow with it.
        random_crop_pad: Largest random shift of training images, in pixels; 0 leaves them. PTR: 4.
    """

    hidden_dims: list[int] = field(default_factory=lambda: [256, 256])
    dropout: float = 0.1
    action_noise: float = 0.0
    tasks: list[str] = field(default_factory=list)
    encoder: str = "small"
    encoder_image_size: tuple[int, int] | None = None
    random_crop_pad: int = 0

    def __post_init__(self) -> None:
        super().__post_init__()
        check_acting(self)
        if self.encoder not in ENCODERS:
            raise ValueError(f"--policy.encoder={self.encoder!r} is not one of {', '.join(ENCODERS)}.")
        if self.random_crop_pad < 0:
            raise ValueError(f"--policy.random_crop_pad={self.random_crop_pad}: expected pixels, 0 or more.")
        if self.compile_model:
            raise ValueError(
                f"--policy.compile_model=true: {self.type} has nothing to compile. Leave the flag out."
            )

    @property
    def action_dim(self) -> int:
        """Size of the action."""
        return feature_dim(self.output_features, ACTION)

    @property
    def image_size(self) -> tuple[int, int]:
        """(H, W) that the encoder takes."""
        return self.encoder_image_size or super().image_size

    def fill_from_dataset(self, dataset_meta: LeRobotDatasetMetadata) -> None:
        """Take the tasks and the cameras' sizes."""
        self.tasks = task_names(dataset_meta)
        found = dataset_to_policy_features(dataset_meta.features)
        for key in self.input_features.keys() & found.keys():
            self.input_features[key] = found[key]

    def validate_features(self) -> None:
        """Choose the cameras and the image size; the inputs are then the cameras and proprioception.

        Raises:
            ValueError: The cameras cannot be used, or there is no proprioception or no action.
        """
        self.choose_cameras()
        self.encoder_image_size = self.image_size
        _ = self.state_dim, self.action_dim
        self.remove_inputs(self.input_features.keys() - {*self.cameras, OBS_STATE})
