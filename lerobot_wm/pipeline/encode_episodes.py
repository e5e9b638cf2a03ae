"""Whole episodes through a frozen encoder, a few at a time."""

from collections.abc import Iterator

import torch
from lerobot.datasets.lerobot_dataset import LeRobotDataset
from torch import Tensor
from torch.nn.utils.rnn import pad_sequence

from lerobot_wm.constants import ACTION, OBS_STATE
from lerobot_wm.data.cache import camera_frames
from lerobot_wm.data.tables import column_tensor
from lerobot_wm.policies.cameras import stack_images
from lerobot_wm.policies.frozen_encoder import EncoderPolicy

_EPISODES_PER_BATCH = 16
_FRAMES_PER_CHUNK = 512  # images per encoder call: bounds memory whatever the length of the episodes


@torch.no_grad()
def filter_episodes(
    policy: EncoderPolicy, dataset: LeRobotDataset, *, sample: bool = False
) -> Iterator[Tensor]:
    """Latents of every episode of `dataset`, a few episodes at a time.

    Args:
        policy: The world model, on the device it shall run on.
        dataset: The image dataset it filters.
        sample: Draw z_t instead of taking its mean.

    Yields:
        For each episode in order, s_t for its frames: (T, L) float32 on the CPU.
    """
    policy.eval()
    world_model, image_size = policy.world_model, policy.config.image_size
    device = next(world_model.parameters()).device
    # Of each camera (N, H, W, C) uint8, by absolute index.
    cameras = [camera_frames(dataset, key) for key in policy.config.cameras]
    columns = {
        key: column_tensor(dataset.hf_dataset, key, tuple(dataset.meta.features[key]["shape"]))
        for key in ("episode_index", "index", ACTION, OBS_STATE)
    }
    _, lengths = torch.unique_consecutive(columns["episode_index"], return_counts=True)
    stops = lengths.cumsum(0).tolist()
    episodes = [slice(stop - length, stop) for stop, length in zip(stops, lengths.tolist(), strict=True)]

    for begin in range(0, len(episodes), _EPISODES_PER_BATCH):
        batch = episodes[begin : begin + _EPISODES_PER_BATCH]
        embeds = []
        for rows in batch:
            index = columns["index"][rows].split(_FRAMES_PER_CHUNK)
            proprio = columns[OBS_STATE][rows].to(device).split(_FRAMES_PER_CHUNK)
            chunks = [
                world_model.embed(
                    stack_images([_images(frames[i].to(device)) for frames in cameras], image_size)[None],
                    p[None],
                )[0]
                for i, p in zip(index, proprio, strict=True)
            ]
            embeds.append(torch.cat(chunks))  # (T, E)
        # The filter is causal: what pads the shorter episodes comes after their last frame.
        actions = pad_sequence([columns[ACTION][rows] for rows in batch], batch_first=True).to(device)
        states = world_model.filter_embeds(pad_sequence(embeds, batch_first=True), actions, sample=sample)
        for rows, latents in zip(batch, states.latent.cpu(), strict=True):
            yield latents[: rows.stop - rows.start]


def _images(frames: Tensor) -> Tensor:
    """(T, H, W, C) uint8 -> (T, C, H, W) in [0, 1]."""
    return frames.movedim(-1, -3).float() / 255
