"""Configuration of the world model as a LeRobot policy type."""

import logging
from dataclasses import dataclass, field
from typing import ClassVar

from lerobot.configs import PreTrainedConfig
from lerobot.datasets.dataset_metadata import LeRobotDatasetMetadata

from lerobot_wm.constants import ACTION, REWARD
from lerobot_wm.data.tables import last_action_predicts_next
from lerobot_wm.policies.common.features import feature_dim
from lerobot_wm.policies.common.iql import reward_columns
from lerobot_wm.policies.common.optim import FusedAdamConfig
from lerobot_wm.policies.world_model.config import WorldModelConfig
from lerobot_wm.world_model.config import RSSMConfig

logger = logging.getLogger(__name__)

# Of the training windows, where actions are hidden from the filter; in the others it learns what actions do.
_HIDDEN_SHARE = 0.5


@PreTrainedConfig.register_subclass("wm_rssm")
@dataclass
class WMRSSMConfig(WorldModelConfig):
    """The paper's RSSM, trained on windows of images and actions (section 3.1.1).

    Several cameras are one image with more channels. Its error is summed over all of them, so each camera adds to the
    weight of the image against the KL.

    Args:
        rssm: Sizes and loss weights; its input sizes are filled from the dataset.
        reward_key: The dataset's column that is the reward; without next.reward in the dataset, none is learned.
        window_length: Steps per training window T. A window starts at any frame, from a zero state.
        lr: Learning rate of Adam.
        grad_clip_norm: Joint gradient norm above which gradients are scaled down.
    """

    predicts_images: ClassVar[bool] = True
    scales_latents: ClassVar[bool] = False

    lr: float = 6e-4
    rssm: RSSMConfig = field(default_factory=RSSMConfig)
    reward_key: str = REWARD
    window_length: int = 25
    grad_clip_norm: float = 100.0

    def __post_init__(self) -> None:
        super().__post_init__()
        if self.window_length < 2:
            raise ValueError(f"--policy.window_length={self.window_length}: expected at least 2 steps.")
        # Not a setting: LeRobot's sampler reads it.
        self.drop_n_last_frames = self.window_length - 1

    def fit_windows(self, shortest_episode: int) -> None:
        """Let LeRobot's sampler start windows in every episode, including those shorter than a window.

        The sampler leaves out the last frames of each episode. These are as many as keep windows within their episodes,
        or fewer where the shortest episode is shorter than a window. Windows then run past the end of the others too;
        the loss leaves this padding out.
        """
        self.drop_n_last_frames = min(self.window_length, shortest_episode) - 1

    @property
    def observation_delta_indices(self) -> list[int]:
        """Frames of a window, relative to its first."""
        return list(range(self.window_length))

    @property
    def action_delta_indices(self) -> list[int]:
        """Frames of a window and those after it whose actions are predicted, relative to its first."""
        return list(range(self.window_length + self.rssm.action_horizon - 1))

    @property
    def reward_delta_indices(self) -> list[int]:
        """Frames of a window, relative to its first."""
        return list(range(self.window_length))

    @property
    def latent_dim(self) -> int:
        """Size of s_t = [d_t, z_t]."""
        return self.rssm.latent_dim

    @property
    def memory_dim(self) -> int:
        """Size of d_t."""
        return self.rssm.deter_dim

    @property
    def features_read(self) -> list[str]:
        """Cameras, and proprioception where it is modelled."""
        return [*self.cameras, *(self.state_vectors if self.rssm.use_proprio else [])]

    @property
    def image_size(self) -> tuple[int, int]:
        """The model's own size."""
        return self.rssm.image_size, self.rssm.image_size

    def has_reward(self, dataset_meta: LeRobotDatasetMetadata) -> bool:
        """Whether the dataset has a reward to predict.

        Raises:
            ValueError: It lacks the column that was asked for.
        """
        known = reward_columns(dataset_meta)
        if self.reward_key not in known and self.reward_key != REWARD:
            raise ValueError(
                f"--policy.reward_key={self.reward_key}: {dataset_meta.repo_id} has no such column. Its columns with "
                f"one number per frame are {', '.join(known) or 'none'}: name one of these, or {REWARD}, without which "
                "no reward is learned."
            )
        return self.reward_key in known

    def check_dataset(self, dataset_meta: LeRobotDatasetMetadata) -> None:
        """Check that a reward that was asked for is there."""
        self.has_reward(dataset_meta)

    def fill_from_dataset(self, dataset_meta: LeRobotDatasetMetadata) -> None:
        """Forget the input sizes, leave out a reward head without reward, and choose what the filter gets."""
        rssm = self.rssm
        rssm.action_dim = rssm.image_channels = rssm.proprio_dim = 0
        rssm.predict_reward &= self.has_reward(dataset_meta)
        if rssm.hidden_action_share is None:
            rssm.hidden_action_share = _HIDDEN_SHARE if last_action_predicts_next(dataset_meta) else 0.0
            if rssm.hidden_action_share:
                logger.info(
                    "Actions hardly change from one frame to the next: the filter does not get them, so that policies "
                    "do not copy their own last action (--policy.rssm.hidden_action_share=0 gives them)."
                )

    def validate_features(self) -> None:
        """Choose the cameras and fill the model's input sizes from the features.

        Raises:
            ValueError: The cameras cannot be used, there is no action, or sizes differ from the checkpoint's.
        """
        super().validate_features()
        sizes = {
            "action_dim": feature_dim(self.output_features, ACTION),
            "image_channels": self.image_shape[0],
        }
        if self.rssm.use_proprio:
            sizes["proprio_dim"] = self.state_dim
        for name, size in sizes.items():
            known = getattr(self.rssm, name)
            if known not in (0, size):
                raise ValueError(
                    f"This world model was built for {name} {known}, here it is {size}: use the kind of dataset or "
                    "environment it was trained on, or train another world model."
                )
            setattr(self.rssm, name, size)

    def get_optimizer_preset(self) -> FusedAdamConfig:
        """Adam 6e-4 with gradients clipped at 100, as in Dreamer V1 and TorchRL."""
        return FusedAdamConfig(lr=self.lr, grad_clip_norm=self.grad_clip_norm)
