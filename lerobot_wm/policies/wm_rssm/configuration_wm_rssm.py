"""Configuration of the world model as a LeRobot policy type."""

from dataclasses import dataclass, field
from typing import ClassVar

from lerobot.configs import PreTrainedConfig

from lerobot_wm.constants import ACTION, OBS_STATE
from lerobot_wm.nn.conv import IMAGE_SIZE
from lerobot_wm.policies.common.config import CompileConfig
from lerobot_wm.policies.common.features import feature_dim, training_dtype
from lerobot_wm.policies.common.lr_decay import LRDecayConfig
from lerobot_wm.policies.common.optim import FusedAdamConfig
from lerobot_wm.policies.common.rewards import RewardConfig
from lerobot_wm.policies.world_model.config import WorldModelConfig
from lerobot_wm.world_model.config import RSSMConfig


@PreTrainedConfig.register_subclass("wm_rssm")
@dataclass
class WMRSSMConfig(LRDecayConfig, CompileConfig, WorldModelConfig, RewardConfig):
    """The paper's RSSM, trained on windows of images and actions (section 3.1.1).

    Several cameras are one image of more channels to it. Its error is summed over them all, so that each camera adds
    to the weight of the image against the KL.

    Args:
        rssm: Sizes and loss weights; its input sizes are filled from the dataset.
        window_length: Steps per training window T. A window starts at any frame from a zero state.
        lr: Learning rate of Adam.
        grad_clip_norm: Joint gradient norm above which gradients are scaled down.
        dtype: Autocast type of training, "bfloat16" or "float32"; None picks what the device is fast in, once: a
            checkpoint keeps it.
    """

    predicts_images: ClassVar[bool] = True
    scales_latents: ClassVar[bool] = False

    rssm: RSSMConfig = field(default_factory=RSSMConfig)
    window_length: int = 25
    lr: float = 6e-4
    grad_clip_norm: float = 100.0
    dtype: str | None = None

    def __post_init__(self) -> None:
        super().__post_init__()
        if self.window_length < 2:
            raise ValueError(f"window_length is {self.window_length}; a window needs at least 2 steps.")
        self.dtype = training_dtype(self.dtype, str(self.device))
        self.drop_n_last_frames = self.window_length - 1  # no setting: read by LeRobot's sampler

    def fit_windows(self, shortest_episode: int) -> None:
        """Have LeRobot's sampler start windows in every episode, however short.

        It leaves out the last frames of each: as many as keep windows within their episodes, or fewer where the
        shortest is shorter than a window. Then windows run past the end of the others too; padding counts for nothing.
        """
        self.drop_n_last_frames = min(self.window_length, shortest_episode) - 1

    @property
    def observation_delta_indices(self) -> list[int]:
        """Frames of a window, relative to its first."""
        return list(range(self.window_length))

    @property
    def action_delta_indices(self) -> list[int]:
        """Frames of a window, relative to its first."""
        return list(range(self.window_length))

    @property
    def reward_delta_indices(self) -> list[int]:
        """Frames of a window, relative to its first."""
        return list(range(self.window_length))

    @property
    def latent_dim(self) -> int:
        """Size of s_t = [d_t, z_t]."""
        return self.rssm.latent_dim

    @property
    def features_read(self) -> list[str]:
        """Cameras, and proprioception where it is modelled."""
        return [*self.cameras, *([OBS_STATE] if self.rssm.use_proprio else [])]

    @property
    def image_size(self) -> tuple[int, int]:
        """The model's own size."""
        return IMAGE_SIZE, IMAGE_SIZE

    def validate_features(self) -> None:
        """Choose the cameras and fill the model's input sizes from the dataset's features.

        Raises:
            ValueError: The cameras cannot be used, there is no action, or sizes are unlike the checkpoint's.
        """
        super().validate_features()
        sizes = {
            "action_dim": feature_dim(self.output_features, ACTION),
            "image_channels": self.image_shape[0],
        }
        if self.rssm.use_proprio:
            sizes["proprio_dim"] = feature_dim(self.input_features, OBS_STATE)
        for name, size in sizes.items():
            known = getattr(self.rssm, name)
            if known not in (0, size):
                raise ValueError(
                    f"This world model was made for {name} {known}, here it is {size}: use the kind of dataset or "
                    "environment it was trained on, or train another world model."
                )
            setattr(self.rssm, name, size)

    def get_optimizer_preset(self) -> FusedAdamConfig:
        """Adam 6e-4 with gradients clipped at 100, as in Dreamer V1 and TorchRL."""
        return FusedAdamConfig(lr=self.lr, grad_clip_norm=self.grad_clip_norm)
