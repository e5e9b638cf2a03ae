"""Whether a policy fits the dataset it is trained on or the environment it acts in, checked before work starts."""

import json
import shlex
from collections.abc import Collection, Mapping
from pathlib import Path

from lerobot.configs import FeatureType, PolicyFeature, PreTrainedConfig
from lerobot.datasets.dataset_metadata import LeRobotDatasetMetadata
from lerobot.datasets.utils import STATS_PATH
from lerobot.envs.configs import EnvConfig
from lerobot.envs.utils import env_to_policy_features
from lerobot.utils.constants import DEFAULT_FEATURES, OBS_STR

from lerobot_wm.constants import ACTION, OBS_IMAGES, OBS_LATENT, OBS_STATE
from lerobot_wm.envs.configuration import MetaworldMTEnvConfig
from lerobot_wm.envs.tasks import resolve_tasks, task_description
from lerobot_wm.policies.common.config import PolicyConfig, check_cameras_present, train_new
from lerobot_wm.policies.common.features import (
    OWN_NAMES,
    current_names,
    image_keys,
    names_before,
    policy_features,
    renamed,
)
from lerobot_wm.policies.common.tasks import check_tasks


def check_fit(
    config: PreTrainedConfig,
    other: LeRobotDatasetMetadata | EnvConfig,
    rename_map: Mapping[str, str] = OWN_NAMES,
) -> None:
    """Check that a policy of this package fits a dataset to train on, or an environment to act in.

    Other policies are left to LeRobot.

    Args:
        config: The policy's configuration; with `pretrained_path`, that of its checkpoint with changes by flags.
        other: The dataset's metadata (of images or latents), or the environment's configuration.
        rename_map: New names of the features of the dataset or environment.

    Raises:
        ValueError: Cameras, sizes, rewards or tasks do not fit.
    """
    if not isinstance(config, PolicyConfig):
        return
    if isinstance(other, EnvConfig):
        _check_environment(config, other, rename_map)
        return
    config.check_dataset(other)
    if config.pretrained_path is None:
        check_names(other)
    else:
        check_reads(config, other, rename_map)


def check_reads(
    config: PolicyConfig,
    dataset_meta: LeRobotDatasetMetadata,
    rename_map: Mapping[str, str] = OWN_NAMES,
) -> None:
    """Check that a dataset has all that a trained policy or world model reads, in the sizes it was trained with.

    Raises:
        ValueError: A feature is missing or has another size. Cameras may have any size, and a policy may read latents
            instead. Or `rename_map` names the action, which LeRobot renames nowhere.
    """
    if ACTION in rename_map.values():
        raise ValueError(
            f"--rename_map={json.dumps(dict(rename_map))} renames observations only, and not '{ACTION}'. Use a renamed "
            f"copy: {rename_command(dataset_meta.repo_id, dataset_meta.root, rename_map)}"
        )
    keys = _vectors(config)
    missing = [key for key in names_before(keys, rename_map) if key not in dataset_meta.features]
    if missing:
        raise ValueError(
            f"{dataset_meta.repo_id} has no {', '.join(missing)}, which this {config.type} reads; it has "
            f"{', '.join(dataset_meta.features)}. Use a dataset of the kind it was trained on, or --rename_map."
        )
    check_sizes(config, dataset_meta, rename_map)
    reads_latents = config.chooses_actions and OBS_LATENT in dataset_meta.features
    if not reads_latents:
        cameras = [rename_map.get(key, key) for key in dataset_meta.camera_keys]
        check_cameras_present(config, cameras, dataset_meta.repo_id)


def check_names(dataset_meta: LeRobotDatasetMetadata) -> None:
    """Check that a dataset to train a new policy on has an action, and cameras with LeRobot's names.

    LeRobot applies `--rename_map` to checkpoints only.

    Raises:
        ValueError: It has other names; gives the command that renames them.
    """
    features = dataset_meta.features
    cameras = [key for key in dataset_meta.camera_keys if not key.startswith(f"{OBS_STR}.")]
    if ACTION in features and not cameras:
        return
    names = {key: f"{OBS_IMAGES}.{key}" for key in cameras}
    names |= {key: ACTION for key in ("actions",) if key in features and ACTION not in features}
    names |= {key: OBS_STATE for key in ("state",) if key in features and OBS_STATE not in features}
    raise ValueError(
        f"{dataset_meta.repo_id} has {', '.join(key for key in features if key not in DEFAULT_FEATURES)}; LeRobot "
        f"reads cameras named '{OBS_IMAGES}.NAME', '{OBS_STATE}' and '{ACTION}'. Train on a renamed copy: "
        f"{rename_command(dataset_meta.repo_id, dataset_meta.root, names or {'OLD': ACTION})}"
    )


def rename_command(repo_id: str, root: str | Path | None, names: Mapping[str, str]) -> str:
    """The command that makes a copy of a dataset with these new names."""
    place = [] if root is None else [f"--dataset.root={root}"]
    copy = f"{root or repo_id.rsplit('/')[-1]}_renamed"
    flags = [f"--dataset.repo_id={repo_id}", *place, f"--rename_map={json.dumps(dict(names))}"]
    flags += [f"--output_repo_id={repo_id}_renamed", f"--output_root={copy}"]
    return f"lerobot-wm rename {shlex.join(flags)}"


def check_sizes(
    config: PolicyConfig, dataset_meta: LeRobotDatasetMetadata, rename_map: Mapping[str, str]
) -> None:
    """Check a dataset's actions and vectors against the sizes a policy was trained with, where it has them.

    Raises:
        ValueError: A size differs; names both.
    """
    features = renamed(policy_features(dataset_meta), rename_map)
    for key in filter(features.__contains__, _vectors(config)):
        known = (config.output_features if key == ACTION else config.input_features)[key].shape
        if known != features[key].shape:
            raise ValueError(
                f"This {config.type} was trained with '{key}' of size {known[0]}; {dataset_meta.repo_id} has size "
                f"{features[key].shape[0]}. Use data of the same robot, or {train_new(config)}."
            )


def check_has_stats(dataset_meta: LeRobotDatasetMetadata) -> None:
    """Check that a training dataset has statistics, which scale actions and proprioception.

    LeRobot's loop would train without them.

    Raises:
        ValueError: It has none; says how to compute them.
    """
    if dataset_meta.stats is None:
        raise ValueError(
            f"{dataset_meta.repo_id} has no statistics ({dataset_meta.root}/{STATS_PATH}), which scale actions and "
            "proprioception: compute them with lerobot-edit-dataset --operation.type=recompute_stats."
        )


def dataset_cameras(config: PolicyConfig, dataset_meta: LeRobotDatasetMetadata) -> dict[str, PolicyFeature]:
    """The policy's cameras as a dataset has them, as far as their names tell; none of a dataset of latents.

    Names are those inside `names_given_by`. Under lerobot-train, which does not tell them, cameras that all have one
    size need none.
    """
    features = policy_features(dataset_meta)
    shapes = {features[key].shape for key in image_keys(features)}
    alike = {key: PolicyFeature(FeatureType.VISUAL, *shapes) for key in config.cameras if len(shapes) == 1}
    known = renamed(features, current_names())
    return alike | {key: known[key] for key in config.cameras if key in known}


def _vectors(config: PolicyConfig) -> list[str]:
    """Keys of the vectors that a trained policy reads or predicts."""
    inputs = config.input_features
    vectors = [
        key for key in config.features_read if key in inputs and inputs[key].type is not FeatureType.VISUAL
    ]
    # A frozen image backbone reads no actions.
    return vectors if config.action_dim is None else [*vectors, ACTION]


def _check_environment(config: PolicyConfig, env: EnvConfig, rename_map: Mapping[str, str]) -> None:
    if not config.chooses_actions:
        raise ValueError(
            f"A {config.type} makes latents and chooses no actions: train a policy on them, --policy.type=wm_bc or "
            "wm_iql, and evaluate that. To train without evaluation, leave out --env.type or set --env_eval_freq=0."
        )
    features = renamed(env_to_policy_features(env), rename_map)
    cameras: Collection[str] = image_keys(features)
    if not isinstance(env, MetaworldMTEnvConfig):
        # What other environments show is known when they are built; some declare fewer cameras than they have.
        if not set(cameras) <= set(config.cameras):
            check_cameras_present(config, cameras, f"--env.type={env.type}")
        return
    check_cameras_present(config, cameras, f"--env.type={env.type} --env.camera_name={env.camera_name}")
    config.check_shapes({key: tuple(feature.shape) for key, feature in features.items()})
    check_tasks(config, {task_description(task) for task in resolve_tasks(env.task)})
