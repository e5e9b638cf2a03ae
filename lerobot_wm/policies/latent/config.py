"""What the configurations of the policies on world-model latents share."""

from dataclasses import dataclass
from pathlib import Path

import torch
from lerobot.configs import FeatureType, PolicyFeature
from lerobot.datasets.dataset_metadata import LeRobotDatasetMetadata

from lerobot_wm.constants import OBS_ENV_STATE, OBS_LATENT
from lerobot_wm.data.latents import RECORD_PATH, LatentKind, LatentRecord
from lerobot_wm.policies.common.acting_config import ActingConfig
from lerobot_wm.policies.common.checkpoint import CheckpointError, open_checkpoint
from lerobot_wm.policies.common.config import train_new
from lerobot_wm.policies.common.features import feature_dim
from lerobot_wm.policies.common.tasks import task_names
from lerobot_wm.policies.world_model.config import WorldModelConfig

_MIN_LATENT_STD = 1e-5  # below it, scaling latents to unit variance would scale rounding errors


@dataclass
class LatentPolicyConfig(ActingConfig):
    """A small multi-task policy on [latent, one-hot task, proprioception] (paper section 3.1.2).

    Args:
        world_model_path: Folder or Hub id of the checkpoint of a world model (wm_rssm) or of a frozen_backbone in its
            place; its frozen weights become part of this policy's.
        use_latent: False leaves the latent out: the blind control, which reads proprioception and task id only.
        use_memory: False encodes each frame by itself, as the first of an episode, and keeps z_t of [d_t, z_t]. A
            policy can recognize demonstrations by what has happened so far, and then fails where nobody has been.
        use_environment_state: True adds the simulator's full state, `observation.environment_state`. With
            `use_latent=false` this is the control that knows the truth. The environment has to provide it.
        random_crop_pad: Largest random shift of training images, in pixels; 0 leaves them. Each image is encoded with
            eight random shifts, and training chooses one of them each time. From few demonstrations a policy needs it.
        save_predicted_video: True lets `lerobot-eval` write a video of each batch of rollouts beside its own
            (`pred_episode_N.mp4`): what the world model expected to see at every step, and to its right what it saw.
        world_model, image_key, world_model_fingerprint: Taken from that checkpoint when the policy is created.
    """

    world_model_path: str | None = None
    use_latent: bool = True
    use_memory: bool = True
    use_environment_state: bool = False
    random_crop_pad: int = 0
    save_predicted_video: bool = False
    world_model: WorldModelConfig | None = None
    world_model_fingerprint: str | None = None

    def __post_init__(self) -> None:
        super().__post_init__()
        if self.random_crop_pad < 0:
            raise ValueError(f"--policy.random_crop_pad={self.random_crop_pad}: expected pixels, 0 or more.")

    @property
    def image_size(self) -> tuple[int, int]:
        """(H, W) that the world model takes."""
        return super().image_size if self.world_model is None else self.world_model.image_size

    @property
    def env_state_dim(self) -> int:
        """Size of the simulator's full state; 0 where the policy does not read it."""
        return feature_dim(self.input_features, OBS_ENV_STATE) if self.use_environment_state else 0

    @property
    def latent_dim(self) -> int:
        """How many numbers of s_t, its last ones, the policy reads; 0 for a policy without latents."""
        if self.world_model is None:
            return 0
        return self.world_model.latent_dim - (0 if self.use_memory else self.world_model.memory_dim)

    @property
    def latent_kind(self) -> LatentKind:
        """Which latents the policy reads."""
        return LatentKind(self.use_memory, self.random_crop_pad)

    @property
    def scales_latents(self) -> bool:
        """Whether the policy scales its latents by the dataset's statistics."""
        return self.world_model is not None and self.world_model.scales_latents

    @property
    def freezes_world_model(self) -> bool:
        """Whether the world model stays as pretrained."""
        return True

    @property
    def reads_stored_latents(self) -> bool:
        """Whether training reads the latents that `lerobot-wm encode` stores, and not images."""
        return self.use_latent and self.freezes_world_model

    @property
    def observation_dim(self) -> int:
        """Size of the networks' input: latent, one-hot task, proprioception, full state."""
        return self.latent_dim + len(self.tasks) + self.state_dim + self.env_state_dim

    def fill_from_dataset(self, dataset_meta: LeRobotDatasetMetadata) -> None:
        """Take the tasks; the world model is read again from its path."""
        super().fill_from_dataset(dataset_meta)
        self.world_model = None

    def validate_features(self) -> None:
        """Take the world model's configuration from its checkpoint, and reduce the inputs to those read at test time.

        Raises:
            ValueError: There is no world model, a feature is missing, the action has another size than the world
                model's, or `save_predicted_video` is set where nothing predicts.
            FileNotFoundError: The world model's checkpoint is not there.
        """
        if not self.use_latent:
            self.world_model = None
        elif self.world_model is None:
            self._take_world_model()
        _ = self.state_dim, self.env_state_dim
        read = {*self.state_vectors, *self.cameras, OBS_ENV_STATE if self.use_environment_state else None}
        if self.world_model is not None:
            read |= set(self.world_model.proprio_vectors)
        self.remove_inputs(self.input_features.keys() - read)
        if not self.input_features:
            raise ValueError(
                "--policy.use_latent=false, and the dataset has no proprioception for --policy.state_keys: this policy "
                "would see nothing."
            )
        model = self.world_model
        if self.save_predicted_video and not self.use_memory:
            raise ValueError(
                "--policy.save_predicted_video=true shows what the memory expects, and --policy.use_memory=false "
                "has none: leave one of the two flags out."
            )
        if self.save_predicted_video and (model is None or not model.predicts_images):
            raise ValueError(
                f"--policy.save_predicted_video=true, but this {self.type} has no world model that predicts images (it "
                f"has {'no latents' if model is None else model.type}): leave the flag out, or use a policy on the "
                "latents of a wm_rssm."
            )
        if model is not None and model.action_dim not in (None, self.action_dim):
            raise ValueError(
                f"The world model was trained with {model.action_dim}-d actions, this dataset or environment has "
                f"{self.action_dim}-d ones: use the one it was trained on, or train another world model."
            )

    def _take_world_model(self) -> None:
        if self.world_model_path is None:
            raise ValueError(
                f"--policy.type={self.type} needs --policy.world_model_path=<folder or Hub id of a wm_rssm checkpoint>."
            )
        self.world_model = open_world_model(self.world_model_path)
        self.image_key = self.world_model.image_key
        for key in self.world_model.cameras:
            self.input_features[key] = self.world_model.input_features[key]

    def check_unchanged(self, saved: "LatentPolicyConfig") -> None:  # type: ignore[override]
        """Also check that the world model is the checkpoint's."""
        if self.world_model_path != saved.world_model_path:
            raise ValueError(
                f"--policy.world_model_path={self.world_model_path}: the checkpoint of --policy.path contains its own "
                f"world model, {saved.world_model_path}, which it was trained on. Leave the flag out, or "
                f"{train_new(saved)}."
            )
        super().check_unchanged(saved)

    def check_latents(self, dataset_meta: LeRobotDatasetMetadata) -> None:
        """Check that a dataset has latents, that they are of this world model, and that they vary.

        The policy is then for cameras of the size that the latents were made from, whatever the world model was trained
        on.

        Raises:
            ValueError: They do not fit; says how to encode the dataset.
        """
        if OBS_LATENT not in dataset_meta.features:
            raise ValueError(
                f"{dataset_meta.repo_id} has no '{OBS_LATENT}'. Encode it with the world model first (`lerobot-wm "
                f"encode --world_model_path=... --dataset.repo_id={dataset_meta.repo_id} ...`), or train with "
                "`lerobot-wm train`, which encodes it automatically."
            )
        record = LatentRecord.read(Path(dataset_meta.root))
        tasks = task_names(dataset_meta)
        if record.tasks != tasks:
            raise ValueError(
                f"{Path(dataset_meta.root) / RECORD_PATH} is of latents of the tasks {record.tasks}, but "
                f"{dataset_meta.repo_id} has {tasks}: it belongs to another dataset or revision. Encode "
                f"{record.source_repo_id} again."
            )
        record.check_world_model(self.world_model_fingerprint, self.world_model_path)
        record.check_cameras(self.cameras, self.world_model_path)
        record.check_kind(self.latent_kind)
        for key, shape in record.camera_shapes.items():
            self.input_features[key] = PolicyFeature(FeatureType.VISUAL, tuple(shape))
        std = torch.as_tensor((dataset_meta.stats or {})[OBS_LATENT]["std"]).median().item()
        if self.scales_latents and std < _MIN_LATENT_STD:
            raise ValueError(
                f"The latents of {self.world_model_path} hardly vary (median standard deviation {std:.1e}): a "
                "policy would be blind. In an image backbone without trained weights the signal fades from layer to "
                "layer: give --policy.weights_path to `lerobot-wm init`, or choose a residual network such as "
                "resnet18. A world model whose latents are all the same needs another training loss."
            )


def open_world_model(path: str) -> WorldModelConfig:
    """The configuration of the world model in a checkpoint: a world model's, or that of a policy on latents.

    Args:
        path: Folder, Hub id, or user/name@revision.

    Raises:
        FileNotFoundError: A file of the checkpoint is missing.
        CheckpointError: It is damaged, or holds no world model.
    """
    config = open_checkpoint(path, with_processors=False)
    if isinstance(config, WorldModelConfig):
        return config
    if isinstance(config, LatentPolicyConfig) and config.world_model is not None:
        return config.world_model
    raise CheckpointError(
        f"{path} ({config.type}) holds no world model: give a checkpoint of wm_rssm, frozen_backbone or another type "
        "of world model, or of a policy on their latents such as wm_bc or wm_iql."
    )
