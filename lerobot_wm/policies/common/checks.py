"""What must fit before work starts: a policy, and the dataset or environment it is to be used with."""

from collections.abc import Collection, Mapping
from copy import deepcopy

import torch
from lerobot.configs import FeatureType, PreTrainedConfig
from lerobot.datasets.dataset_metadata import LeRobotDatasetMetadata
from lerobot.envs.configs import EnvConfig
from lerobot.envs.utils import env_to_policy_features
from lerobot.policies.factory import get_policy_class

from lerobot_wm.constants import ACTION, OBS_LATENT
from lerobot_wm.envs.configuration import MetaworldMTEnvConfig
from lerobot_wm.envs.tasks import resolve_tasks, task_description
from lerobot_wm.policies.common.cameras import ImagePolicyConfig, check_observation
from lerobot_wm.policies.common.checkpoint import read_config
from lerobot_wm.policies.common.features import names_before, renamed
from lerobot_wm.policies.common.fine_tuning import (
    check_kept,
    check_networks,
    check_sizes,
    fit_to_dataset,
    names_given_by,
)
from lerobot_wm.policies.common.iql_agent import end_column
from lerobot_wm.policies.common.iql_config import IQLConfig
from lerobot_wm.policies.common.multi_task_config import MultiTaskConfig
from lerobot_wm.policies.latent.config import LatentPolicyConfig
from lerobot_wm.policies.world_model.config import WorldModelConfig


def check_dataset_fits(
    config: PreTrainedConfig, dataset_meta: LeRobotDatasetMetadata, rename_map: dict[str, str]
) -> None:
    """Refuse to train a policy of this package on a dataset that lacks what it needs; others are left to LeRobot.

    What needs the policy itself is checked when it is made; this is for what would be found after images were encoded
    for it.

    Args:
        config: Of the policy.
        dataset_meta: Of the dataset, of images or of latents.
        rename_map: New names of the dataset's features.

    Raises:
        ValueError: It lacks rewards or cameras, or has actions or numbers of another size than the checkpoint; or the
            policy's settings are not those of the checkpoint's networks.
    """
    if isinstance(config, IQLConfig):
        end_column(config, dataset_meta)
    if not isinstance(config, ImagePolicyConfig) or config.pretrained_path is None:
        return
    saved = read_config(config.pretrained_path, config.pretrained_revision)
    assert isinstance(saved, ImagePolicyConfig)  # LeRobot has read it, as `config`
    check_kept(config, saved)
    check_networks(get_policy_class(saved.type), config, saved)
    if OBS_LATENT not in dataset_meta.features:
        cameras = [rename_map.get(key, key) for key in dataset_meta.camera_keys]
        _check_cameras(saved, cameras, dataset_meta.repo_id)
    with names_given_by(rename_map):
        fit_to_dataset(deepcopy(config), saved, dataset_meta)


def check_encoder_fits(
    config: ImagePolicyConfig, dataset_meta: LeRobotDatasetMetadata, rename_map: Mapping[str, str]
) -> None:
    """Refuse to encode a dataset without the numbers that a world model reads, or with them in another size.

    Args:
        config: Of the world model, or of a policy on its latents.
        dataset_meta: Of the dataset of images.
        rename_map: New names of its features.

    Raises:
        ValueError: A feature is missing or of another size than in training.
    """
    model = config.world_model if isinstance(config, LatentPolicyConfig) else config
    assert isinstance(model, WorldModelConfig)  # `load_encoder` takes nothing else
    keys = [key for key in model.features_read if key not in model.cameras]
    keys += [] if model.action_dim is None else [ACTION]
    missing = [key for key in names_before(keys, rename_map) if key not in dataset_meta.features]
    if missing:
        raise ValueError(
            f"{dataset_meta.repo_id} has no {', '.join(missing)}, which the world model reads; it has "
            f"{', '.join(dataset_meta.features)}: use a dataset of the kind it was trained on."
        )
    check_sizes(
        model,
        keys,
        dataset_meta,
        rename_map,
        "encode data of the same robot, or train another world model on this dataset",
    )


def check_environment_fits(config: PreTrainedConfig, env: EnvConfig, rename_map: dict[str, str]) -> None:
    """Refuse to evaluate a policy of this package in an environment that it cannot act in.

    What other environments than metaworld_mt show is known when they are built: of them the cameras alone are checked.

    Args:
        config: Of the policy.
        env: Of the environment.
        rename_map: New names of the environment's features.

    Raises:
        ValueError: The policy has no actions, or has not seen such cameras, images, numbers or tasks.
    """
    if isinstance(config, WorldModelConfig):
        raise ValueError(
            f"{config.pretrained_path} ({config.type}) makes latents and chooses no actions: train a policy on them, "
            "--policy.type=wm_bc or wm_iql, and evaluate that."
        )
    if not isinstance(config, ImagePolicyConfig):
        return
    features = renamed(env_to_policy_features(env), rename_map)
    visual = [key for key, feature in features.items() if feature.type is FeatureType.VISUAL]
    if not isinstance(env, MetaworldMTEnvConfig):
        if not set(visual) <= set(config.cameras):  # some declare fewer than they show
            _check_cameras(config, visual, f"--env.type={env.type}")
        return
    _check_cameras(config, visual, f"--env.type={env.type} --env.camera_name={env.camera_name}")
    check_observation(config, {key: torch.zeros(1, *feature.shape) for key, feature in features.items()})
    if isinstance(config, LatentPolicyConfig):
        config.check_environment_state(features)
    if isinstance(config, MultiTaskConfig):
        config.check_tasks({task_description(task) for task in resolve_tasks(env.task)})


def _check_cameras(config: ImagePolicyConfig, shown: Collection[str], where: str) -> None:
    missing = [key for key in config.cameras if key not in shown]
    if missing:
        raise ValueError(
            f"This {config.type} sees {', '.join(missing)}; {where} has the cameras {', '.join(shown) or 'none'}: use "
            "one with all it sees (--env.camera_name of metaworld_mt), or give these names to cameras that show the "
            "same, by --rename_map."
        )
