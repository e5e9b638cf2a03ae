"""The order in which LeRobot's sampler draws samples, looked up for a whole epoch at once."""

import math
from collections.abc import Iterator
from typing import Any

import torch
from lerobot.datasets.sampler import EpisodeAwareSampler
from torch.utils.data import BatchSampler, DataLoader


class EpochOrder:
    """Yields what a shuffling `EpisodeAwareSampler` yields, in the same order, and moves it on by the same epochs.

    The sampler searches each sample's episode in Python, which for a batch of latents takes longer than gathering it.

    Args:
        sampler: LeRobot's; a state loaded into it counts from the next epoch on.
        multiple: Each epoch is filled up with its first samples to a multiple of so many.
    """

    def __init__(self, sampler: EpisodeAwareSampler, multiple: int = 1) -> None:
        self._sampler = sampler
        self._rows = torch.tensor(sampler.indices)  # (N,) dataset row of each position of the sampler
        self._length = math.ceil(len(self._rows) / multiple) * multiple

    def __iter__(self) -> Iterator[int]:
        state = self._sampler.state_dict()
        iter(self._sampler)  # counts the epoch
        generator = self._sampler._epoch_generator(state["epoch"])
        order = torch.randperm(len(self._rows), generator=generator)  # (N,)
        filled = order[torch.arange(state["start_index"], self._length) % len(order)]
        return iter(self._rows[filled].tolist())

    def __len__(self) -> int:
        return self._length


def batches_of_rows(data_loader: DataLoader, *, fill: bool = False) -> Any:
    """The batch sampler of a loader that LeRobot built, or a faster one of the same batches.

    Args:
        data_loader: The loader.
        fill: Fill the last batch of an epoch that is shuffled up with the epoch's first samples.
    """
    sampler = data_loader.sampler
    if not (isinstance(sampler, EpisodeAwareSampler) and sampler.shuffle):
        return data_loader.batch_sampler
    size = data_loader.batch_size
    assert size is not None  # LeRobot's loaders batch
    return BatchSampler(EpochOrder(sampler, size if fill else 1), size, data_loader.drop_last)
