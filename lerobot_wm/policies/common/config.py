"""The settings that all our policy types share."""

import logging
from collections.abc import Callable, Collection, Iterable, Mapping
from dataclasses import dataclass, field
from typing import Any, ClassVar, Self

import torch
from lerobot.configs import FeatureType, NormalizationMode, PolicyFeature, PreTrainedConfig
from lerobot.datasets.dataset_metadata import LeRobotDatasetMetadata
from lerobot.optim import LRSchedulerConfig

from lerobot_wm.constants import ACTION, OBS_ENV_STATE, OBS_STATE
from lerobot_wm.nn.images import channels_first
from lerobot_wm.policies.common.features import feature_dim, image_keys
from lerobot_wm.policies.common.optim import FinalDecayConfig, FusedAdamConfig

logger = logging.getLogger(__name__)

# Scaling is part of our models (lerobot_wm.nn.normalize): a policy and the frozen world model inside it are fitted to
# different statistics, which one processor pipeline cannot hold. LeRobot's normalizers do nothing.
IDENTITY_NORMALIZATION: dict[str, NormalizationMode] = dict.fromkeys(
    ("VISUAL", "STATE", "ENV", "ACTION"), NormalizationMode.IDENTITY
)


_IMAGE_AXES = 3  # (C, H, W)


@dataclass
class PolicyConfig(PreTrainedConfig):
    """Base of all our policy configurations: cameras, precision, and Adam at one learning rate.

    Args:
        image_key: The cameras, separated by commas: observation.images.corner2,observation.images.topview. Their images
            are stacked in this order. None takes all cameras of the dataset, without depth where there is colour.
        state_keys: The vectors that are read as proprioception, separated by commas, and joined in this order:
            observation.state,observation.effort. None takes observation.state where the dataset has it. World models
            read them with `rssm.use_proprio` only.
        lr: Learning rate of Adam.
        lr_decay_share: Last part of the training steps, over which the learning rate falls linearly to zero. 0, as in
            the paper, keeps it constant. Not for IQL, whose actors follow a cosine.
        dtype: Autocast type of training, "bfloat16" or "float32". None picks the faster one for the device once; the
            checkpoint keeps it.
        compile_model: Compile the networks (`torch.compile`): the recurrence of a world model, the networks of a policy
            on latents. Compiling takes minutes at the start; on a GPU the networks then run as CUDA graphs.
    """

    # Whether policies of this type choose actions. World models do not.
    chooses_actions: ClassVar[bool] = True

    normalization_mapping: dict[str, NormalizationMode] = field(
        default_factory=lambda: dict(IDENTITY_NORMALIZATION)
    )
    image_key: str | None = None
    state_keys: str | None = None
    lr: float = 3e-4
    lr_decay_share: float = 0.0
    dtype: str | None = None
    compile_model: bool = False

    def __post_init__(self) -> None:
        super().__post_init__()
        scaled = {
            name: mode.value
            for name, mode in self.normalization_mapping.items()
            if mode != NormalizationMode.IDENTITY
        }
        if scaled:
            raise ValueError(
                f"--policy.normalization_mapping={scaled}: these models scale their inputs themselves, and LeRobot "
                "would scale them a second time. Leave the flag out."
            )
        if self.n_obs_steps != 1:
            raise ValueError(
                f"--policy.n_obs_steps={self.n_obs_steps}: these policies read one frame at a time; the world model "
                "remembers earlier ones. Leave the flag out."
            )
        if not 0 <= self.lr_decay_share <= 1:
            raise ValueError(
                f"--policy.lr_decay_share={self.lr_decay_share:g}: expected a share between 0 and 1."
            )
        self.dtype = training_dtype(self.dtype, str(self.device))

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

    def get_optimizer_preset(self) -> FusedAdamConfig:
        """Adam without clipping."""
        return FusedAdamConfig(lr=self.lr)

    def get_scheduler_preset(self) -> LRSchedulerConfig | None:
        """A constant learning rate; with `lr_decay_share` it falls to zero at the end."""
        return FinalDecayConfig(share=self.lr_decay_share) if self.lr_decay_share else None

    @property
    def cameras(self) -> list[str]:
        """Feature keys of the cameras; empty for a policy without images, or before `choose_cameras`."""
        return self.image_key.split(",") if self.image_key else []

    @property
    def features_read(self) -> list[str]:
        """Keys of the observation that the policy reads."""
        return list(self.input_features)

    @property
    def image_size(self) -> tuple[int, int]:
        """(H, W) that the images of all cameras are resized to: the first camera's."""
        _, height, width = self.input_features[self.cameras[0]].shape
        return height, width

    @property
    def image_shape(self) -> tuple[int, int, int]:
        """(C, H, W) of the stacked images."""
        channels = sum(self.input_features[key].shape[0] for key in self.cameras)
        return channels, *self.image_size

    @property
    def state_vectors(self) -> list[str]:
        """Feature keys of the vectors that are joined to the proprioceptive state; may be empty."""
        if self.state_keys is None:
            return [OBS_STATE] if OBS_STATE in self.input_features else []
        return [key.strip() for key in self.state_keys.split(",") if key.strip()]

    @property
    def state_dim(self) -> int:
        """Size of the proprioceptive state; 0 without proprioception."""
        return sum(feature_dim(self.input_features, key) for key in self.state_vectors)

    @property
    def action_dim(self) -> int | None:
        """Size of the actions that the model reads or chooses; None where it reads none."""
        return feature_dim(self.output_features, ACTION)

    def choose_cameras(self) -> None:
        """Check `image_key`, or take all cameras where it is None; other cameras are removed from the inputs.

        Depth, which has one channel, is left out by default where there are cameras with more.

        Raises:
            ValueError: There is no camera, one is unknown or repeated, or their numbers of channels differ.
        """
        known = image_keys(self.input_features)
        if self.image_key is None:
            depth = [key for key in known if self.input_features[key].shape[0] == 1]
            chosen = [key for key in known if key not in depth] or known
            if chosen != known:
                logger.info(
                    "Cameras: %s. Not read, as they have one channel: %s. --policy.image_key chooses others.",
                    ", ".join(chosen),
                    ", ".join(depth),
                )
        else:
            chosen = [key.strip() for key in self.image_key.split(",")]
        if not chosen or not set(chosen) <= set(known) or len(set(chosen)) < len(chosen):
            raise ValueError(
                f"--policy.image_key is {self.image_key!r}; the dataset has the cameras {', '.join(known) or 'none'}. "
                f"{self.type} needs at least one: set --policy.image_key to some of these, separated by commas, "
                "without repeating any."
            )
        # LeRobot takes axes for (C, H, W) unless the last one is called "channel" or "channels".
        for key in chosen:
            self.input_features[key] = PolicyFeature(
                FeatureType.VISUAL, channels_first(self.input_features[key].shape)
            )
        channels = {key: self.input_features[key].shape[0] for key in chosen}
        if len(set(channels.values())) > 1:
            raise ValueError(
                f"The cameras have different numbers of channels: {channels}. Set --policy.image_key to cameras with "
                "the same number, separated by commas."
            )
        self.image_key = ",".join(chosen)
        self.remove_inputs(set(known) - set(chosen))

    def remove_inputs(self, keys: Iterable[str]) -> None:
        """Leave out features that the policy does not read."""
        for key in keys:
            del self.input_features[key]

    def fill_from_dataset(self, dataset_meta: LeRobotDatasetMetadata) -> None:
        """Take what a new policy needs to know of its dataset, such as the tasks, before its networks are built.

        Values are replaced, not kept: the settings may be those of a finished run. Subclasses extend this.
        """

    def check_dataset(self, dataset_meta: LeRobotDatasetMetadata) -> None:
        """Check that the dataset has what training needs besides observations and actions, such as rewards.

        Raises:
            ValueError: Something is missing.
        """

    def check_unchanged(self, saved: Self) -> None:
        """Check that flags leave alone what the weights of a checkpoint depend on. Subclasses extend this.

        Args:
            saved: The configuration as it is in the checkpoint.

        Raises:
            ValueError: A flag changed it, or the environment or robot has actions of another size.
        """
        if [key.strip() for key in self.cameras] != saved.cameras:
            raise ValueError(
                f"--policy.image_key={self.image_key}: this {saved.type} was trained on the cameras "
                f"{saved.image_key or 'none'}, in this order. Leave the flag out, map other cameras to these names "
                f"with --rename_map, or {train_new(saved)}."
            )
        if self.state_vectors != saved.state_vectors:
            raise ValueError(
                f"--policy.state_keys={self.state_keys}: this {saved.type} was trained on "
                f"{', '.join(saved.state_vectors) or 'none'}, in this order. Leave the flag out, or {train_new(saved)}."
            )
        known, found = saved.output_features.get(ACTION), self.output_features.get(ACTION)
        if known is not None and found is not None and tuple(known.shape) != tuple(found.shape):
            raise ValueError(
                f"This {saved.type} was trained with '{ACTION}' of size {known.shape[0]}, the robot, environment or "
                f"dataset has size {found.shape[0]}: use the kind it was trained on, or {train_new(saved)}."
            )

    def check_shapes(self, shapes: Mapping[str, tuple[int, ...]]) -> None:
        """Check the shapes of one observation against those the policy was trained on.

        Args:
            shapes: Shape of each feature, without the batch: (C, H, W) of cameras, (N,) of vectors.

        Raises:
            ValueError: A feature is missing or has another shape; says where it can be set.
        """
        cameras = [key for key, shape in shapes.items() if len(shape) == _IMAGE_AXES]
        check_cameras_present(self, cameras, "the observation")
        for key in self.features_read:
            expected = tuple(self.input_features[key].shape)
            if key not in shapes:
                raise ValueError(
                    f"The observation has no '{key}'; this policy was trained with {expected[0]} numbers. "
                    f"{_HINTS.get(key, 'Add it to the robot or environment')}."
                )
            if shapes[key] == expected:
                continue
            if key in self.cameras:
                raise ValueError(
                    f"'{key}' is {shapes[key]}, this policy was trained on {expected} (C, H, W): set the camera or "
                    f"environment to height {expected[1]} and width {expected[2]} (--robot.cameras of a robot, "
                    f"--env.image_size={expected[1]} for metaworld_mt)."
                )
            raise ValueError(
                f"'{key}' has {shapes[key][-1]} numbers, this policy was trained with {expected[0]}: use the kind of "
                "robot or environment its dataset was recorded on."
            )


_HINTS = {
    OBS_STATE: "Add it to the robot or environment (--env.obs_type=pixels_agent_pos of LeRobot's environments)",
    OBS_ENV_STATE: (
        "Evaluate with --env.environment_state=true (metaworld_mt), or train without "
        "--policy.use_environment_state"
    ),
}


def train_new(config: PreTrainedConfig) -> str:
    """Advice for the end of a message: how to get a policy with other networks."""
    return f"train a new {config.type} with --policy.type={config.type} instead of --policy.path"


def check_cameras_present(config: PolicyConfig, present: Collection[str], where: str) -> None:
    """Check that all cameras of a trained policy are among those `present`; `where` names their source.

    Raises:
        ValueError: A camera is missing; names it and those present.
    """
    missing = [key for key in config.cameras if key not in present]
    if missing:
        raise ValueError(
            f"This {config.type} needs the cameras {', '.join(missing)}; {where} has {', '.join(present) or 'none'}. "
            "Add them (--env.camera_name=corner2,topview for metaworld_mt), or map cameras with the same view to these "
            "names with --rename_map."
        )


def training_dtype(dtype: str | None, device: str) -> str:
    """The autocast type of training: `dtype`, or the device's default where it is None.

    Raises:
        ValueError: It is unknown; LeRobot and accelerate would use float32 without a word.
    """
    if dtype not in (None, "bfloat16", "float32"):
        raise ValueError(f"--policy.dtype is '{dtype}'; expected 'bfloat16' or 'float32'.")
    return dtype or default_dtype(device)


def default_dtype(device: str) -> str:
    """The autocast type in which training is fastest: bfloat16 where the hardware multiplies it, else float32."""
    if device.startswith("cuda"):
        return "bfloat16" if torch.cuda.is_bf16_supported(including_emulation=False) else "float32"
    return "bfloat16" if device == "cpu" and torch.cpu._is_avx512_bf16_supported() else "float32"


def compiled[**Inputs](function: Callable[Inputs, Any]) -> Callable[Inputs, Any]:
    """Compile `function` at its first call, and again for inputs of another shape.

    Its random numbers come from other generators than the plain function's. On a GPU it runs as CUDA graphs, whose
    outputs the next call overwrites.
    """
    return torch.compile(function, mode="reduce-overhead", dynamic=False)
