"""What holds for windows, padding, shares and merged datasets of any sizes."""

import tempfile
from pathlib import Path
from typing import Any

import numpy as np
import pandas as pd
import torch
from hypothesis import given, settings
from hypothesis import strategies as st
from lerobot.datasets.compute_stats import get_feature_stats
from lerobot.datasets.io_utils import load_stats
from lerobot.datasets.lerobot_dataset import LeRobotDataset
from torch import Tensor

from lerobot_wm.collect.merge import merge_datasets
from lerobot_wm.data.loader import RamDataset, gather
from lerobot_wm.data.source import open_dataset
from lerobot_wm.workers import Job
from tests.recording import record, vector

SETTINGS: dict[str, Any] = {"deadline": None, "database": None, "derandomize": True}
LENGTHS = st.lists(st.integers(1, 9), min_size=1, max_size=5)
FEATURES = {"observation.state": vector(2), "action": vector(2)}


class Rows(RamDataset):
    """Windows over episodes of some lengths, without a dataset on disk."""

    def __init__(self, lengths: list[int]) -> None:
        ends = torch.tensor(lengths).cumsum(0)
        counts = torch.tensor(lengths)
        self.device = torch.device("cpu")
        self._first = (ends - counts).repeat_interleave(counts)
        self._last = (ends - 1).repeat_interleave(counts)

    def windows(self, deltas: tuple[int, ...]) -> tuple[Tensor, Tensor]:
        """Rows and padding (N, T) of every row's window."""
        self._offsets = {deltas: torch.tensor(deltas)}
        return self._window(torch.arange(len(self._first)), deltas)


@settings(max_examples=300, **SETTINGS)
@given(lengths=LENGTHS, deltas=st.lists(st.integers(-12, 12), min_size=1, max_size=6))
def test_windows_stay_in_their_episode_and_say_what_is_padding(lengths: list[int], deltas: list[int]) -> None:
    rows, is_pad = Rows(lengths).windows(tuple(deltas))
    episode = np.repeat(np.arange(len(lengths)), lengths)
    for row, (window, padding) in enumerate(zip(rows.tolist(), is_pad.tolist(), strict=True)):
        for delta, there, padded in zip(deltas, window, padding, strict=True):
            wanted = row + delta
            inside = 0 <= wanted < len(episode) and episode[wanted] == episode[row]
            assert padded != inside
            assert episode[there] == episode[row]
            assert (
                there == wanted
                if inside
                else abs(there - wanted)
                == min(abs(k - wanted) for k in np.flatnonzero(episode == episode[row]))
            )


@settings(max_examples=200, **SETTINGS)
@given(data=st.data(), rows=st.integers(1, 30), length=st.integers(1, 6))
def test_gathering_is_indexing(data: st.DataObject, rows: int, length: int) -> None:
    source = torch.arange(rows * 3).reshape(rows, 3)
    starts = data.draw(st.lists(st.integers(0, rows - 1), min_size=1, max_size=5))
    index = (torch.tensor(starts)[:, None] + torch.arange(length)).clamp(max=rows - 1)
    assert torch.equal(gather(source, index), source[index])


@settings(max_examples=200, **SETTINGS)
@given(n_parts=st.integers(1, 60), count=st.integers(1, 60))
def test_shares_are_everything_once_and_even(n_parts: int, count: int) -> None:
    shares = [Job(index, count).select(range(n_parts)) for index in range(1, count + 1)]
    assert sorted(part for share in shares for part in share) == list(range(n_parts))
    assert max(map(len, shares)) - min(map(len, shares)) <= 1


@settings(max_examples=8, **SETTINGS)
@given(groups=st.lists(LENGTHS, min_size=1, max_size=3))
def test_merging_keeps_every_frame_and_its_statistics(groups: list[list[int]]) -> None:
    with tempfile.TemporaryDirectory() as folder:
        sources = [
            Path(record(Path(folder) / str(i), FEATURES, [(f"Task {n % 3}", n) for n in lengths]).root)
            for i, lengths in enumerate(groups)
        ]
        merged = Path(folder) / "merged"
        merge_datasets(sources, "test/merged", merged)
        open_dataset("test/merged", merged)
        before = pd.concat([table_of(source) for source in sources], ignore_index=True)
        after = table_of(merged)
        pd.testing.assert_frame_equal(after[["task", "state", "action"]], before[["task", "state", "action"]])
        assert list(after["index"]) == list(range(len(after)))
        stats = load_stats(merged)
        actions = np.stack(after["action"].to_list())
        for name, value in get_feature_stats(actions, axis=0, keepdims=False).items():
            if name in ("min", "max", "mean", "std", "count"):
                np.testing.assert_allclose(stats["action"][name], value, rtol=1e-4, atol=1e-6)


def table_of(root: Path) -> pd.DataFrame:
    """A dataset's rows, with the words of their tasks."""
    dataset = LeRobotDataset("test/x", root=root)
    table = dataset.hf_dataset.with_format(None).to_pandas()
    table["task"] = dataset.meta.tasks.index[table["task_index"]].to_numpy()
    return table.rename(columns={"observation.state": "state"})
