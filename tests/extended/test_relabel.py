"""`lerobot-wm relabel`: the same dataset, rewarded by another column."""

import json
from collections.abc import Callable
from pathlib import Path

import numpy as np
import pandas as pd
import pyarrow.parquet as pq
import pytest
import torch
from lerobot.datasets.dataset_tools import add_features, modify_features
from lerobot.datasets.lerobot_dataset import LeRobotDataset

from lerobot_wm.commands.relabel import relabel
from lerobot_wm.data.latents import dataset_fingerprint
from lerobot_wm.files import sole_writer
from tests.flags import DATASET_FLAGS


@pytest.fixture(scope="module")
def dense(
    demos_root: Path, tmp_path_factory: pytest.TempPathFactory, lerobot_wm_command: Callable[..., None]
) -> LeRobotDataset:
    root = tmp_path_factory.mktemp("dense") / "dataset"
    lerobot_wm_command(
        "relabel --reward=next.dense_reward --output_repo_id=test/dense",
        DATASET_FLAGS.format(root=demos_root),
        f"--output_root={root}",
    )
    return LeRobotDataset("test/dense", root=root)


def test_nothing_but_the_reward_differs(dense: LeRobotDataset, demos: LeRobotDataset) -> None:
    assert dense.features == demos.features
    for index in (0, 100, demos.num_frames - 1):
        ours, theirs = dense[index], demos[index]
        assert ours["next.reward"] == theirs["next.dense_reward"]
        for key in ours.keys() - {"next.reward", "task"}:
            assert torch.equal(ours[key], theirs[key]), key
        assert ours["task"] == theirs["task"]
    assert not torch.equal(
        torch.stack(list(dense.hf_dataset["next.reward"])), torch.stack(list(demos.hf_dataset["next.reward"]))
    )


def test_statistics_are_those_of_the_new_reward(dense: LeRobotDataset, demos: LeRobotDataset) -> None:
    """Of the dataset and of each episode: LeRobot merges datasets by the latter."""
    rewards = torch.stack(list(dense.hf_dataset["next.reward"])).numpy()
    assert dense.meta.stats["next.reward"]["max"] == pytest.approx(rewards.max())
    assert dense.meta.stats["next.reward"]["mean"] == pytest.approx(rewards.mean(), rel=1e-4)
    np.testing.assert_equal(dense.meta.stats["action"], demos.meta.stats["action"])
    [file] = (Path(dense.root) / "meta" / "episodes").rglob("*.parquet")
    for _, episode in pd.read_parquet(file).iterrows():
        rows = slice(episode["dataset_from_index"], episode["dataset_to_index"])
        assert episode["stats/next.reward/max"] == pytest.approx(rewards[rows].max())


def test_tables_keep_a_row_group_for_each_episode(dense: LeRobotDataset) -> None:
    """By which LeRobot finds an episode in a large file."""
    groups = [
        pq.read_metadata(file).num_row_groups for file in (Path(dense.root) / "data").rglob("*.parquet")
    ]
    assert sum(groups) == dense.meta.total_episodes > 1


def test_it_says_where_the_reward_comes_from(dense: LeRobotDataset, demos_root: Path) -> None:
    record = json.loads((Path(dense.root) / "meta" / "relabel.json").read_text())
    assert record["reward"] == "next.dense_reward"
    assert record["source_fingerprint"] == dataset_fingerprint(demos_root)
    # how it was collected, too
    assert (Path(dense.root) / "meta" / "collection.json").read_bytes() == (
        demos_root / "meta" / "collection.json"
    ).read_bytes()


@pytest.mark.parametrize("reward", ["next.shaped", "next.success", "observation.state"])
def test_what_is_no_reward_is_refused(reward: str, demos: LeRobotDataset, tmp_path: Path) -> None:
    with pytest.raises(ValueError, match=r"next\.reward, next\.dense_reward"):
        relabel(demos, reward, "test/other", tmp_path / "other")
    assert not any(tmp_path.iterdir())


def test_a_folder_is_never_overwritten(demos: LeRobotDataset, tmp_path: Path) -> None:
    with pytest.raises(FileExistsError, match=str(tmp_path)):
        relabel(demos, "next.dense_reward", "test/other", tmp_path)


def test_one_writer_at_a_time(demos: LeRobotDataset, tmp_path: Path) -> None:
    """Another would remove what this one has begun."""
    with sole_writer(tmp_path / "other"), pytest.raises(BlockingIOError, match="another process is writing"):
        relabel(demos, "next.dense_reward", "test/other", tmp_path / "other")


def test_a_column_of_ones_own_needs_no_statistics(demos: LeRobotDataset, tmp_path: Path) -> None:
    """LeRobot's `add_features` writes none."""
    values = np.linspace(0, 1, demos.num_frames, dtype=np.float32)
    feature = {"dtype": "float32", "shape": (1,), "names": None}
    source = add_features(demos, {"next.shaped": (values, feature)}, tmp_path / "source", "test/source")
    shaped = relabel(source, "next.shaped", "test/shaped", tmp_path / "shaped")
    np.testing.assert_array_equal(np.ravel(list(shaped.hf_dataset["next.reward"])), values)
    assert shaped.meta.stats["next.reward"]["mean"] == pytest.approx(values.mean())
    [file] = (Path(shaped.root) / "meta" / "episodes").rglob("*.parquet")
    last = pd.read_parquet(file).iloc[-1]
    assert last["stats/next.reward/min"] == pytest.approx(values[last["dataset_from_index"]])


def test_without_a_reward_the_column_is_named_in_training(demos: LeRobotDataset, tmp_path: Path) -> None:
    without = modify_features(demos, remove_features="next.reward", output_dir=tmp_path / "without")
    with pytest.raises(ValueError, match=r"'next\.reward'.*--policy\.reward_key=next\.dense_reward"):
        relabel(without, "next.dense_reward", "test/other", tmp_path / "other")
    assert not (tmp_path / "other").exists()
