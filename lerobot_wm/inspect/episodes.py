"""World models that imagine images, and the episodes of image datasets that they are shown."""

from collections.abc import Iterator
from dataclasses import dataclass
from typing import Any

import torch
from lerobot.datasets.dataset_metadata import LeRobotDatasetMetadata
from lerobot.datasets.lerobot_dataset import LeRobotDataset
from torch import Tensor

from lerobot_wm.constants import ACTION, TASK
from lerobot_wm.data.source import SourceConfig
from lerobot_wm.nn.images import camera_images, resize_images
from lerobot_wm.policies.common.checks import check_reads
from lerobot_wm.policies.common.config import check_cameras_present
from lerobot_wm.policies.common.features import join_vectors
from lerobot_wm.policies.latent.policy import LatentPolicy, encoder_config, load_encoder
from lerobot_wm.policies.wm_rssm.configuration_wm_rssm import WMRSSMConfig
from lerobot_wm.policies.wm_rssm.modeling_wm_rssm import WMRSSMPolicy
from lerobot_wm.world_model.model import WorldModel
from lerobot_wm.world_model.rssm import RSSMState

# Frames that are read before they are resized: bounds memory for long episodes of large images.
_FRAMES_AT_ONCE = 64

type ImaginingPolicy = WMRSSMPolicy | LatentPolicy


@dataclass
class CheckpointConfig:
    """`--policy.path`, as in `lerobot-eval`."""

    path: str


def load_world_model(path: str) -> ImaginingPolicy:
    """Load a checkpoint that holds an RSSM: wm_rssm, or a policy on its latents. See `load_encoder`.

    Raises:
        ValueError: The checkpoint holds none.
    """
    policy = load_encoder(path)
    if not isinstance(policy, WMRSSMPolicy | LatentPolicy) or not isinstance(policy.world_model, WorldModel):
        raise ValueError(
            f"{path} ({policy.config.type}) holds no world model that imagines images. Give a wm_rssm checkpoint, or a "
            "policy on its latents."
        )
    return policy.eval()


def rssm_of(policy: ImaginingPolicy) -> WorldModel:
    """The policy's world model, which is an RSSM: `load_world_model` accepts no other."""
    assert isinstance(policy.world_model, WorldModel)
    return policy.world_model


def world_model_config(policy: ImaginingPolicy) -> WMRSSMConfig:
    """The configuration that the policy's world model was trained with."""
    config = encoder_config(policy)
    assert isinstance(config, WMRSSMConfig)
    return config


def reward_key(policy: ImaginingPolicy) -> str:
    """The column that the world model's reward head learned; the policy's own `reward_key` may differ."""
    return world_model_config(policy).reward_key


def keys_read(policy: ImaginingPolicy) -> list[str]:
    """What the world model and the policy read from a dataset."""
    return [*policy.config.features_read, ACTION]


def check_features(policy: ImaginingPolicy, meta: LeRobotDatasetMetadata) -> None:
    """Check that an image dataset has what the policy reads, in the size it was trained on; images may have any size.

    Raises:
        ValueError: A feature is missing or has another size.
    """
    check_reads(policy.config, meta)
    # `check_reads` accepts latents in place of cameras.
    check_cameras_present(policy.config, meta.camera_keys, meta.repo_id)


def episodes_by_task(meta: LeRobotDatasetMetadata, min_length: int = 1) -> dict[str, list[int]]:
    """Indices of each task's episodes of at least `min_length` frames; tasks in the order they occur."""
    found: dict[str, list[int]] = {}
    lengths, tasks = meta.episodes["length"][:], meta.episodes["tasks"][:]
    for index, (length, of_episode) in enumerate(zip(lengths, tasks, strict=True)):
        if length >= min_length:
            found.setdefault(of_episode[0], []).append(index)
    return found


def read_episodes(
    policy: ImaginingPolicy,
    meta: LeRobotDatasetMetadata,
    source: SourceConfig,
    episodes: list[int],
    max_frames: int | None = None,
) -> Iterator[dict[str, Any]]:
    """Read episodes one after another; no other episode's images are decoded.

    Args:
        policy: The world model, or a policy on it.
        meta: The dataset's metadata.
        source: Where the dataset is.
        episodes: Indices in ascending order.
        max_frames: How many frames of each to read, from the first on; None reads all.

    Yields:
        What the policy reads of T frames: each camera (T, C, H, W) in [0, 1] at the model's image size, `action` (T, A)
        and the other keys of `keys_read` (T, ·); the reward that the world model learned (T,) where the dataset has
        it; `task`, under which `episodes_by_task` counts the episode.
    """
    keys = [*keys_read(policy), *({reward_key(policy)} & meta.features.keys())]
    all_lengths, tasks = meta.episodes["length"][:], meta.episodes["tasks"][:]
    lengths = [all_lengths[episode] for episode in episodes]
    times = [step / meta.fps for step in range(min(max(lengths), _FRAMES_AT_ONCE))]
    dataset = LeRobotDataset(
        source.repo_id,
        root=source.root,
        revision=source.revision,
        episodes=episodes,
        delta_timestamps=dict.fromkeys(keys, times),
    )
    # The episode's first frame among those of `episodes`.
    start = 0
    for episode, length in zip(episodes, lengths, strict=True):
        n_frames = min(length, max_frames or length)
        chunks: dict[str, list[Tensor]] = {key: [] for key in keys}
        for position in range(0, n_frames, len(times)):
            # LeRobot repeats an episode's last frame beyond its end.
            window = dataset[start + position]
            for key in keys:
                chunk = window[key][: n_frames - position]
                if key in policy.config.cameras:
                    chunk = resize_images(chunk, policy.config.image_size)
                elif tuple(meta.features[key]["shape"]) == (1,) and key != reward_key(policy):
                    chunk = chunk[:, None]
                chunks[key].append(chunk)
        yield {key: torch.cat(of_key) for key, of_key in chunks.items()} | {TASK: tasks[episode][0]}
        start += length


def stack_episodes(policy: ImaginingPolicy, episodes: list[dict[str, Any]]) -> dict[str, Tensor]:
    """Stack what the policy reads of B episodes of T frames on its device: (B, T, ·) by key."""
    return {
        key: torch.stack([episode[key] for episode in episodes]).to(policy.config.device)
        for key in keys_read(policy)
    }


def filter_frames(
    policy: ImaginingPolicy, batch: dict[str, Tensor], n_frames: int | None = None
) -> RSSMState:
    """Filter the first `n_frames` of stacked episodes, taking z_t at its posterior mean."""
    frames = {key: value[:, :n_frames] for key, value in batch.items()}
    world_model = rssm_of(policy)
    images = camera_images(frames, policy.config.cameras, policy.config.image_size)
    proprio = join_vectors(frames, world_model_config(policy).proprio_vectors)
    return world_model.filter(images, frames[ACTION], proprio)
