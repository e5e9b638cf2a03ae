"""Cameras and vectors by name: their shapes, joined values and statistics."""

from collections.abc import Iterator, Mapping, Sequence
from typing import Any

import torch
from lerobot.configs import FeatureType, PolicyFeature
from lerobot.datasets.dataset_metadata import LeRobotDatasetMetadata
from lerobot.utils.feature_utils import dataset_to_policy_features
from torch import Tensor

from lerobot_wm.constants import OBS_IMAGE
from lerobot_wm.nn.images import channels_first

Statistics = Mapping[str, Mapping[str, Any]]


def feature_dim(features: dict[str, PolicyFeature], key: str) -> int:
    """Size of the vector feature `key`.

    Raises:
        ValueError: The feature is missing, or is no vector.
    """
    if key not in features:
        raise ValueError(f"The dataset has no '{key}'; it has {sorted(features)}.")
    shape = tuple(features[key].shape)
    if len(shape) != 1:
        raise ValueError(f"'{key}' has the shape {shape}; expected a vector (N,).")
    return shape[0]


def policy_features(dataset_meta: LeRobotDatasetMetadata) -> dict[str, PolicyFeature]:
    """LeRobot's description of a dataset's features, with the channels of all cameras first."""
    features = dataset_to_policy_features(dataset_meta.features)
    cameras = {
        key: PolicyFeature(FeatureType.VISUAL, channels_first(features[key].shape))
        for key in image_keys(features)
    }
    return features | cameras


def image_keys(features: dict[str, PolicyFeature]) -> list[str]:
    """The camera keys among the features, in order."""
    return [key for key, feature in features.items() if feature.type is FeatureType.VISUAL]


def join_vectors(batch: Mapping[str, Tensor], keys: Sequence[str]) -> Tensor | None:
    """Vectors (..., N) of a batch side by side in one; None without any."""
    if not keys:
        return None
    return batch[keys[0]] if len(keys) == 1 else torch.cat([batch[key] for key in keys], dim=-1)


def joined_statistics(stats: Statistics, keys: Sequence[str], *names: str) -> Iterator[Tensor]:
    """`statistics` of vectors that are joined by `join_vectors`; empty without any."""
    for name in names:
        yield torch.cat([torch.empty(0), *(value for key in keys for value in statistics(stats, key, name))])


def statistics(stats: Statistics, key: str, *names: str) -> Iterator[Tensor]:
    """Statistics of a dataset's feature, each as a float32 vector.

    Raises:
        ValueError: The dataset has no such statistic.
    """
    for name in names:
        if name not in stats.get(key, {}):
            if key.startswith(OBS_IMAGE):
                fix = "LeRobot computes it for images at recording only: leave out --policy.rssm.standardize_images"
            else:
                fix = "lerobot-edit-dataset --operation.type=recompute_stats writes a copy of the dataset with it"
            raise ValueError(
                f"The dataset's meta/stats.json has no '{name}' of '{key}', which scales the model's inputs: {fix}."
            )
        yield torch.as_tensor(stats[key][name], dtype=torch.float32).flatten()
