"""What a policy on latents settles when it is made: its world model, what it reads, and that latents are its own."""

from pathlib import Path

from lerobot.configs import FeatureType, PolicyFeature
from lerobot.datasets.dataset_metadata import LeRobotDatasetMetadata
from lerobot.policies.factory import get_policy_class

from lerobot_wm.constants import OBS_ENV_STATE, OBS_LATENT, OBS_STATE
from lerobot_wm.data.latents import RECORD_PATH, LatentRecord
from lerobot_wm.policies.common.features import stat
from lerobot_wm.policies.latent.config import LatentPolicyConfig
from lerobot_wm.policies.latent.encoder import encoder_fingerprint, load_encoder
from lerobot_wm.world_model.interface import LatentModel

_MIN_LATENT_STD = 1e-5  # below it, scaling latents to unit variance would scale rounding errors


def take_world_model(config: LatentPolicyConfig, *, anew: bool) -> LatentModel:
    """The world model of a policy: that of its path where the policy is new, one to be filled with weights else.

    A new policy's `config` is told which it is, and of its cameras.

    Args:
        config: The policy's.
        anew: Whether nothing will fill it: the policy is new, even where its settings are another's, which name one.

    Raises:
        ValueError: `world_model_path` is not given, or is no checkpoint with a world model.
    """
    if config.world_model is not None and not anew:
        return get_policy_class(config.world_model.type)(config.world_model).world_model
    if config.world_model_path is None:
        raise ValueError(
            f"--policy.type={config.type} needs --policy.world_model_path=<folder or Hub id of a wm_rssm checkpoint>."
        )
    policy = load_encoder(config.world_model_path)
    # Of a policy on latents, its world model's.
    config.world_model = (
        policy.config.world_model if isinstance(policy.config, LatentPolicyConfig) else policy.config
    )
    config.image_key = policy.config.image_key
    config.input_features |= {key: policy.config.input_features[key] for key in policy.config.cameras}
    config.world_model_fingerprint = encoder_fingerprint(policy.world_model)
    return policy.world_model


def deployed_features(config: LatentPolicyConfig) -> dict[str, PolicyFeature]:
    """What the policy reads at test time: cameras and proprioception, not the stored latent.

    Raises:
        ValueError: The dataset has no proprioception.
    """
    wanted = {OBS_STATE, *config.cameras, OBS_ENV_STATE if config.use_environment_state else None}
    features = {key: feature for key, feature in config.input_features.items() if key in wanted}
    if OBS_STATE not in features or features[OBS_STATE].type is not FeatureType.STATE:
        raise ValueError(f"The dataset has no '{OBS_STATE}'; it has {sorted(config.input_features)}.")
    return features


def check_latents(config: LatentPolicyConfig, dataset_meta: LeRobotDatasetMetadata) -> None:
    """Refuse a dataset without latents, with those of another world model, or with latents that hold nothing.

    The policy is then for cameras of the size that the latents were made from, whatever the world model was trained on.

    Raises:
        ValueError: Says how to encode it.
    """
    if OBS_LATENT not in dataset_meta.features:
        raise ValueError(
            f"{dataset_meta.repo_id} has no '{OBS_LATENT}'. Encode it with the world model first (`lerobot-wm encode "
            f"--world_model_path=... --dataset.repo_id={dataset_meta.repo_id} ...`), or train with `lerobot-wm train`, "
            "which does so by itself."
        )
    record = LatentRecord.read(Path(dataset_meta.root))
    tasks = [str(task) for task in dataset_meta.tasks.index]
    if record.tasks != tasks:
        raise ValueError(
            f"{Path(dataset_meta.root) / RECORD_PATH} tells of latents of the tasks {record.tasks}, but "
            f"{dataset_meta.repo_id} has {tasks}: it is another dataset's or revision's. Encode "
            f"{record.source_repo_id} again."
        )
    record.check_world_model(config.world_model_fingerprint, config.world_model_path)
    record.check_cameras(config.cameras, config.world_model_path)
    for key, shape in record.camera_shapes.items():
        config.input_features[key] = PolicyFeature(FeatureType.VISUAL, tuple(shape))
    if config.scales_latents:
        std = stat(dataset_meta.stats, OBS_LATENT, "std").median().item()
        if std < _MIN_LATENT_STD:
            raise ValueError(
                f"The latents of {config.world_model_path} hardly vary (median standard deviation {std:.1e}): a policy "
                "would be blind. Of an image backbone without trained weights the signal fades from layer to layer: "
                "give --policy.weights_path to `lerobot-wm init`, or choose a residual network such as resnet18. A "
                "world model whose latents are all the same needs another training loss."
            )
