"""Whole episodes through a frozen encoder, a batch of a few at a time."""

from collections.abc import Iterator, Mapping, Sequence

import numpy as np
import torch
from lerobot.datasets.lerobot_dataset import LeRobotDataset
from torch import Tensor
from torch.nn.utils.rnn import pad_sequence

from lerobot_wm.constants import ACTION, OBS_STATE
from lerobot_wm.data.cache import camera_frames
from lerobot_wm.data.tables import column_tensor
from lerobot_wm.nn.images import stack_images
from lerobot_wm.policies.common.checks import OWN_NAMES, names_before
from lerobot_wm.policies.latent.policy import EncoderPolicy

_EPISODES_PER_BATCH = 16
_FRAMES_PER_CHUNK = 512  # images per encoder call: bounds memory whatever the length of the episodes


def episode_batches(dataset: LeRobotDataset) -> list[range]:
    """The batches in which a dataset's episodes are encoded. They change its latents' last bits, so they are fixed."""
    total = dataset.meta.total_episodes
    return [range(i, min(i + _EPISODES_PER_BATCH, total)) for i in range(0, total, _EPISODES_PER_BATCH)]


@torch.no_grad()
def filter_batches(
    policy: EncoderPolicy,
    source: LeRobotDataset,
    batches: Sequence[range],
    *,
    rename_map: Mapping[str, str] = OWN_NAMES,
    sample_seed: int | None = None,
) -> Iterator[Tensor]:
    """Latents of some batches of a dataset's episodes; no other episode's images are decoded.

    Args:
        policy: The world model, on the device it shall run on.
        source: The image dataset it filters.
        batches: Some of its `episode_batches`, in their order.
        rename_map: The names that the world model knows the dataset's features by, where they are others.
        sample_seed: Draw z_t, with this seed, instead of taking its mean.

    Yields:
        For each batch, s_t for the frames of its episodes: (N, L) float32 on the CPU.
    """
    policy.eval()
    world_model, image_size = policy.world_model, policy.config.image_size
    device = next(world_model.parameters()).device
    episodes = [episode for batch in batches for episode in batch]
    dataset = LeRobotDataset(source.repo_id, source.root, episodes, revision=source.revision)
    # Of each camera (N, H, W, C) uint8, by absolute index; the files that training reads.
    camera_keys = names_before(policy.config.cameras, rename_map)
    cameras = [camera_frames(dataset, key, image_size) for key in camera_keys]
    all_lengths = source.meta.episodes["length"][:]
    lengths = [all_lengths[episode] for episode in episodes]
    # Of each episode, its rows of a column.
    index, actions, proprio = (
        dict(zip(episodes, _column(dataset, key).split(lengths), strict=True))
        for key in ("index", ACTION, *names_before([OBS_STATE], rename_map))
    )
    for batch in batches:
        embeds = []
        for episode in batch:
            chunks = [
                world_model.embed(
                    stack_images([_images(frames[i].to(device)) for frames in cameras], image_size)[None],
                    p[None],
                )[0]
                for i, p in zip(
                    index[episode].split(_FRAMES_PER_CHUNK),
                    proprio[episode].to(device).split(_FRAMES_PER_CHUNK),
                    strict=True,
                )
            ]
            embeds.append(torch.cat(chunks))  # (T, E)
        # The filter is causal: what pads the shorter episodes comes after their last frame.
        padded_embeds = pad_sequence(embeds, batch_first=True)  # (B, T, E)
        padded_actions = pad_sequence([actions[episode] for episode in batch], batch_first=True).to(device)
        if sample_seed is not None:  # a batch's own: the same whoever encodes it, and after whatever
            [seed] = np.random.SeedSequence([sample_seed, batch.start]).generate_state(1)
            torch.manual_seed(int(seed))
        states = world_model.filter_embeds(padded_embeds, padded_actions, sample=sample_seed is not None)
        latents = states.latent.cpu()  # (B, T, L)
        yield torch.cat([latents[i, : len(embed)] for i, embed in enumerate(embeds)])


def _column(dataset: LeRobotDataset, key: str) -> Tensor:
    return column_tensor(dataset.hf_dataset, key, tuple(dataset.meta.features[key]["shape"]))


def _images(frames: Tensor) -> Tensor:
    """(T, H, W, C) uint8 -> (T, C, H, W) in [0, 1]."""
    return frames.movedim(-1, -3).float() / 255
