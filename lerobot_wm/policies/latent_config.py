"""What the configurations of the policies on world-model latents share."""

from dataclasses import dataclass, field

from lerobot.configs import NormalizationMode, PreTrainedConfig
from lerobot.optim import LRSchedulerConfig

from lerobot_wm.constants import ACTION, OBS_STATE
from lerobot_wm.policies.features import IDENTITY_NORMALIZATION, default_dtype, feature_dim
from lerobot_wm.policies.optim import FusedAdamConfig
from lerobot_wm.world_model.config import RSSMConfig


@dataclass
class LatentPolicyConfig(PreTrainedConfig):
    """A small multi-task policy on [latent, one-hot task, proprioception] (paper section 3.1.2).

    Args:
        world_model_path: Folder or Hub id of a wm_rssm checkpoint; its frozen weights become part of this policy's.
        use_latent: False leaves the latent out: the blind control, proprioception and task id only.
        hidden_dims: Widths of the hidden layers of every network.
        dropout: Dropout of the actor.
        lr: Learning rate of Adam.
        dtype: Autocast type of training, "bfloat16" or "float32"; None picks what the device is fast in.
        rssm, image_key, world_model_fingerprint: Taken from the world model when the policy is made.
        tasks: Task strings in one-hot order, taken from the dataset when the policy is made.
    """

    world_model_path: str | None = None
    use_latent: bool = True
    hidden_dims: list[int] = field(default_factory=lambda: [256, 256])
    dropout: float = 0.1
    lr: float = 3e-4
    dtype: str | None = None
    rssm: RSSMConfig | None = None
    image_key: str | None = None
    world_model_fingerprint: str | None = None
    tasks: list[str] = field(default_factory=list)
    normalization_mapping: dict[str, NormalizationMode] = field(
        default_factory=lambda: dict(IDENTITY_NORMALIZATION)
    )

    def __post_init__(self) -> None:
        super().__post_init__()
        if self.dtype is None:
            self.dtype = default_dtype(str(self.device))

    @property
    def state_dim(self) -> int:
        """Size of the proprioceptive state."""
        return feature_dim(self.input_features, OBS_STATE, "The dataset")

    @property
    def action_dim(self) -> int:
        """Size of the action."""
        return feature_dim(self.output_features, ACTION, "The dataset")

    @property
    def observation_dim(self) -> int:
        """Size of the networks' input: latent, one-hot task, proprioception."""
        latent_dim = self.rssm.latent_dim if self.rssm is not None else 0
        return latent_dim + len(self.tasks) + self.state_dim

    @property
    def observation_delta_indices(self) -> list[int] | None:
        """Single frames."""
        return None

    @property
    def action_delta_indices(self) -> list[int] | None:
        """Single frames."""
        return None

    @property
    def reward_delta_indices(self) -> list[int] | None:
        """Single frames."""
        return None

    def validate_features(self) -> None:
        """Check that proprioception and action are there and fit the frozen world model.

        Raises:
            ValueError: One is missing, or the action has another size than the world model's.
        """
        _ = self.state_dim
        if self.rssm is not None and self.rssm.action_dim != self.action_dim:
            raise ValueError(
                f"The world model was trained with {self.rssm.action_dim}-d actions, this dataset or environment has "
                f"{self.action_dim}-d ones: use the one it was trained on, or train another world model."
            )

    def get_optimizer_preset(self) -> FusedAdamConfig:
        """Adam without clipping (IQL reference implementation)."""
        return FusedAdamConfig(lr=self.lr)

    def get_scheduler_preset(self) -> LRSchedulerConfig | None:
        """A constant learning rate."""
        return None
