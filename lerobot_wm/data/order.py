"""The order in which LeRobot's sampler draws samples, looked up for a whole epoch at once."""

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
    """

    def __init__(self, sampler: EpisodeAwareSampler) -> None:
        self._sampler = sampler
        self._rows = torch.tensor(sampler.indices)  # (N,) dataset row of each position of the sampler

    def __iter__(self) -> Iterator[int]:
        state = self._sampler.state_dict()
        iter(self._sampler)  # counts the epoch
        generator = self._sampler._epoch_generator(state["epoch"])
        order = torch.randperm(len(self._rows), generator=generator)  # (N,)
        return iter(self._rows[order[state["start_index"] :]].tolist())

    def __len__(self) -> int:
        return len(self._rows)


def batches_of_rows(data_loader: DataLoader) -> Any:
    """The batch sampler of a loader that LeRobot built, or a faster one of the same batches."""
    sampler = data_loader.sampler
    if not (isinstance(sampler, EpisodeAwareSampler) and sampler.shuffle):
        return data_loader.batch_sampler
    assert data_loader.batch_size is not None  # LeRobot's loaders batch
    return BatchSampler(EpochOrder(sampler), data_loader.batch_size, data_loader.drop_last)
