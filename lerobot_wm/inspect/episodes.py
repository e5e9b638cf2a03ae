"""Episodes of an image dataset as a world model is shown them: what it reads, and reading it."""

from collections.abc import Iterator
from typing import Any

import torch
from lerobot.datasets.dataset_metadata import LeRobotDatasetMetadata
from lerobot.datasets.lerobot_dataset import LeRobotDataset
from torch import Tensor

from lerobot_wm.constants import ACTION, TASK
from lerobot_wm.data.options import SourceConfig
from lerobot_wm.nn.images import resize_images
from lerobot_wm.policies.latent.policy import LatentPolicy
from lerobot_wm.policies.wm_rssm.configuration_wm_rssm import WMRSSMConfig
from lerobot_wm.policies.wm_rssm.modeling_wm_rssm import WMRSSMPolicy

_FRAMES_AT_ONCE = 64  # read and then made small: bounds memory for long episodes of large images


def shapes_read(policy: WMRSSMPolicy | LatentPolicy) -> dict[str, tuple[int, ...]]:
    """Keys that the model and a policy on it read from a dataset, with their shapes in training (cameras: C, H, W)."""
    config = policy.config
    shapes = {key: tuple(config.input_features[key].shape) for key in config.features_read}
    return shapes | {ACTION: tuple(config.output_features[ACTION].shape)}


def reward_key(policy: WMRSSMPolicy | LatentPolicy) -> str:
    """The column that the world model's reward head learned; wm_iql's own `reward_key` may be another."""
    return world_model_config(policy).reward_key


def world_model_config(policy: WMRSSMPolicy | LatentPolicy) -> WMRSSMConfig:
    """The configuration that the world model, a policy's own or the one it is on, was trained with."""
    config = policy.config if isinstance(policy, WMRSSMPolicy) else policy.config.world_model
    assert isinstance(config, WMRSSMConfig)  # `load_world_model` refuses others
    return config


def check_features(policy: WMRSSMPolicy | LatentPolicy, meta: LeRobotDatasetMetadata) -> None:
    """Refuse a dataset without what the model and a policy on it read; images of any size are resized.

    Raises:
        ValueError: It lacks a feature, or has it in another size.
    """
    shapes = shapes_read(policy)
    missing = [key for key in shapes if key not in meta.features]
    if missing:
        raise ValueError(
            f"{meta.repo_id} has no {', '.join(missing)}; it has {', '.join(sorted(meta.features))}. Give the "
            "--dataset.repo_id of an image dataset like the one the world model was trained on."
        )
    for key in shapes.keys() - policy.config.cameras:
        found = tuple(meta.features[key]["shape"])
        if found != shapes[key]:
            raise ValueError(
                f"'{key}' of {meta.repo_id} is {found}, the checkpoint was trained on {shapes[key]}: "
                "use the kind of dataset it was trained on."
            )


def episodes_by_task(meta: LeRobotDatasetMetadata, min_length: int = 1) -> dict[str, list[int]]:
    """Indices of each task's episodes of at least `min_length` frames; tasks in the order they occur."""
    found: dict[str, list[int]] = {}
    lengths, tasks = meta.episodes["length"][:], meta.episodes["tasks"][:]
    for index, (length, of_episode) in enumerate(zip(lengths, tasks, strict=True)):
        if length >= min_length:
            found.setdefault(of_episode[0], []).append(index)
    return found


def read_episodes(
    policy: WMRSSMPolicy | LatentPolicy,
    meta: LeRobotDatasetMetadata,
    source: SourceConfig,
    episodes: list[int],
    max_frames: int | None = None,
) -> Iterator[dict[str, Any]]:
    """Read episodes one after another; no other's images are decoded.

    Args:
        policy: The model, or a policy on it.
        meta: The dataset's.
        source: Where it is.
        episodes: Which, in ascending order.
        max_frames: How many frames of each, from its first on; None reads it whole.

    Yields:
        What the policy reads of T frames: each camera (T, C, H, W) in [0, 1] at the model's image size, `action` (T, A)
        and the others of `shapes_read` (T, ·); the model's reward (T,) where the dataset has that column; `task`, the
        one that `episodes_by_task` counts it under.
    """
    keys = [*shapes_read(policy), *({reward_key(policy)} & meta.features.keys())]
    all_lengths = meta.episodes["length"][:]
    lengths = [all_lengths[episode] for episode in episodes]
    times = [step / meta.fps for step in range(min(max(lengths), _FRAMES_AT_ONCE))]
    dataset = LeRobotDataset(
        source.repo_id,
        root=source.root,
        revision=source.revision,
        episodes=episodes,
        delta_timestamps=dict.fromkeys(keys, times),
    )
    tasks = meta.episodes["tasks"][:]
    start = 0  # among the frames of these episodes
    for episode, length in zip(episodes, lengths, strict=True):
        stop = min(length, max_frames or length)
        parts: dict[str, list[Tensor]] = {key: [] for key in keys}
        for position in range(0, stop, len(times)):
            window = dataset[start + position]  # beyond its end an episode's last frame is repeated
            for key in keys:
                part = window[key][: stop - position]
                if key in policy.config.cameras:
                    part = resize_images(part, policy.config.image_size)
                parts[key].append(part)
        yield {key: torch.cat(of_key) for key, of_key in parts.items()} | {TASK: tasks[episode][0]}
        start += length
