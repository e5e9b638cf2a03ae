"""An epoch's order looked up at once is the order LeRobot's sampler gives."""

import pytest
import torch
from lerobot.datasets.sampler import EpisodeAwareSampler
from torch.utils.data import DataLoader, TensorDataset

from lerobot_wm.data.loader import EpochOrder, batches_of_rows


def sampler(shuffle: bool = True) -> EpisodeAwareSampler:
    """Of episodes 0 and 2 of three, the last two frames of each left out, in a dataset that holds these alone."""
    rows = {absolute: relative for relative, absolute in enumerate((*range(5), *range(12, 20)))}
    return EpisodeAwareSampler(
        [0, 5, 12],
        [5, 12, 20],
        episode_indices_to_use=[0, 2],
        drop_n_last_frames=2,
        shuffle=shuffle,
        seed=3,
        absolute_to_relative_idx=rows,
    )


@pytest.mark.parametrize("state", [None, {"epoch": 4, "start_index": 7}])
def test_same_order_epoch_after_epoch(state: dict[str, int] | None) -> None:
    theirs, moved = sampler(), sampler()
    for one in (theirs, moved):
        if state is not None:
            one.load_state_dict(state)
    ours = EpochOrder(moved)
    assert len(ours) == len(theirs) == 9
    epochs = [list(theirs) for _ in range(3)]
    assert [list(ours) for _ in range(3)] == epochs
    assert epochs[0] != epochs[1]
    assert moved.state_dict() == theirs.state_dict()


def test_a_state_loaded_later_counts() -> None:
    theirs, moved = sampler(), sampler()
    ours = EpochOrder(moved)
    for one in (theirs, moved):
        one.load_state_dict({"epoch": 1, "start_index": 2})
    assert list(ours) == list(theirs)


def test_same_batches() -> None:
    dataset = TensorDataset(torch.arange(13))
    theirs, ours = (DataLoader(dataset, batch_size=4, sampler=sampler()) for _ in range(2))
    faster = batches_of_rows(ours)
    assert faster is not ours.batch_sampler
    assert len(faster) == len(theirs) == 3
    assert theirs.batch_sampler is not None
    for _ in range(2):
        assert list(faster) == list(theirs.batch_sampler)


def test_other_samplers_are_left_alone() -> None:
    dataset = TensorDataset(torch.arange(13))
    for loader in (
        DataLoader(dataset, batch_size=4),
        DataLoader(dataset, batch_size=4, sampler=sampler(False)),
    ):
        assert batches_of_rows(loader) is loader.batch_sampler
