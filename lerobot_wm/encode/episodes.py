"""Recorded episodes as a world model reads them."""

from collections.abc import Collection, Sequence
from dataclasses import dataclass

import torch
from lerobot.datasets.lerobot_dataset import LeRobotDataset
from torch import Tensor
from torch.nn.utils.rnn import pad_sequence

from lerobot_wm.constants import ACTION
from lerobot_wm.data.cache import camera_frames
from lerobot_wm.data.tables import column_tensor
from lerobot_wm.nn.images import random_crop, stack_images
from lerobot_wm.policies.common.features import join_vectors
from lerobot_wm.world_model.interface import LatentModel

# Images per call of the encoder, which bounds memory for long episodes.
_FRAMES_PER_CHUNK = 512


@dataclass(frozen=True)
class Episode:
    """T frames of a recorded episode, from its first on; what arrives with o_{t+1} is stored at frame t.

    Attributes:
        task: Its task.
        index: Its index in the dataset.
        frames: Each camera's frames at the model's size, (T, H, W, C) uint8, views of the memory-mapped cache.
        columns: Its numbers by key, (T, ·) each; the action is one of them.
        proprio: What the world model reads beside images, (T, P); None if nothing.
    """

    task: str
    index: int
    frames: list[Tensor]
    columns: dict[str, Tensor]
    proprio: Tensor | None

    def __len__(self) -> int:
        return len(self.actions)

    @property
    def actions(self) -> Tensor:
        """a_t in the dataset's units, (T, A)."""
        return self.columns[ACTION]

    def images(self, steps: slice | list[int] = slice(None), device: torch.device | str = "cpu") -> Tensor:
        """The images of these steps with the cameras stacked, (N, K·C, H, W) in [0, 1]."""
        _, height, width, _ = self.frames[0].shape
        images = [frames[steps].to(device).movedim(-1, -3).float() / 255 for frames in self.frames]
        return stack_images(images, (height, width))


def read_episodes(
    dataset: LeRobotDataset,
    cameras: Sequence[str],
    image_size: tuple[int, int],
    *,
    proprio: Sequence[str] = (),
    columns: Collection[str] = (),
    max_frames: int | None = None,
) -> list[Episode]:
    """Read the episodes that a dataset was opened for, in their order; each is decoded once, into the cache.

    Args:
        dataset: The dataset; its `episodes` ascend, or are None for all.
        cameras: Keys of the cameras.
        image_size: (H, W) of the model's images.
        proprio: Keys of the vectors that the world model reads beside images.
        columns: Keys of further columns to read.
        max_frames: How many frames of each episode to read, from the first on; None for all.
    """
    # (N, H, W, C) of each camera, by absolute frame index; the same files as in training.
    frames = [camera_frames(dataset, key, image_size) for key in cameras]
    numbers = {
        key: column_tensor(dataset.hf_dataset, key, shape).view(-1, *shape)
        for key in dict.fromkeys([ACTION, *proprio, *columns])
        for shape in [tuple(dataset.meta.features[key]["shape"])]
    }
    lengths, starts, tasks = (
        dataset.meta.episodes[key][:] for key in ("length", "dataset_from_index", "tasks")
    )
    read, position = [], 0
    for index in range(len(lengths)) if dataset.episodes is None else dataset.episodes:
        kept, start = min(lengths[index], max_frames or lengths[index]), starts[index]
        of_episode = {key: values[position : position + kept] for key, values in numbers.items()}
        read.append(
            Episode(
                task=tasks[index][0],
                index=index,
                frames=[of_camera[start : start + kept] for of_camera in frames],
                columns=of_episode,
                proprio=join_vectors(of_episode, proprio),
            )
        )
        position += lengths[index]
    return read


def embed_episodes(
    world_model: LatentModel, episodes: Sequence[Episode], random_crop_pad: int = 0
) -> tuple[Tensor, Tensor]:
    """Embed the images of B episodes, and pad the shorter ones at their end.

    The filter is causal: padding after the last frame does not change an episode's latents.

    Args:
        world_model: Embeds them.
        episodes: The B episodes.
        random_crop_pad: Largest random shift of each image, in pixels.

    Returns:
        e_t (B, T, E) and a_t (B, T, A) on the model's device.
    """
    device = next(world_model.parameters()).device
    embeds = []
    for episode in episodes:
        chunks = []
        for start in range(0, len(episode), _FRAMES_PER_CHUNK):
            steps = slice(start, start + _FRAMES_PER_CHUNK)
            images = episode.images(steps, device)  # (N, K·C, H, W)
            if random_crop_pad:
                images = random_crop(images, random_crop_pad)
            proprio = None if episode.proprio is None else episode.proprio[steps][None].to(device)
            chunks.append(world_model.embed(images[None], proprio)[0])
        embeds.append(torch.cat(chunks))  # (T, E)
    actions = pad_sequence([episode.actions for episode in episodes], batch_first=True)
    return pad_sequence(embeds, batch_first=True), actions.to(device)
