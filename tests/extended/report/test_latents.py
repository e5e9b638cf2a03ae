"""The map of the latent space, of real frames filtered by a world model that was made lively."""

import shutil
from pathlib import Path

import numpy as np
import pyarrow as pa
import pyarrow.parquet as pq
import pytest
import torch
from lerobot.datasets.lerobot_dataset import LeRobotDataset

from lerobot_wm.constants import ACTION, OBS_IMAGE
from lerobot_wm.data.source import SourceConfig
from lerobot_wm.inspect.episodes import load_world_model
from lerobot_wm.inspect.latent_map import (
    FRAMES_PER_EPISODE,
    LatentMap,
    latent_figures,
    latent_map,
    task_colours,
)
from tests.extended.report.quality_model import lively_world_model


@pytest.fixture(scope="module")
def dataset(episodes_root: Path) -> LeRobotDataset:
    return LeRobotDataset("test/episodes", root=episodes_root)


def source_of(dataset: LeRobotDataset) -> SourceConfig:
    return SourceConfig(dataset.repo_id, str(dataset.root))


@pytest.fixture(scope="module")
def latents(dataset: LeRobotDataset, untrained_path: Path) -> LatentMap:
    policy = load_world_model(str(untrained_path))
    policy.world_model = lively_world_model(untrained_path)
    return latent_map(policy, dataset.meta, source_of(dataset))


@torch.no_grad()
def test_points_are_the_principal_components_of_the_filters_states(
    latents: LatentMap, dataset: LeRobotDataset, untrained_path: Path
) -> None:
    model = lively_world_model(untrained_path)
    states, start, drawn = [], 0, []
    for length in dataset.meta.episodes["length"][:]:
        state, previous = None, torch.zeros(1, 1, 4)
        for t in range(length):
            frame = dataset[start + t]
            state = model.observe(frame[OBS_IMAGE][None, None], previous, state).last()
            previous = frame[ACTION][None, None]
            states.append(state.latent[0].numpy())
        frames = np.linspace(0, length - 1, min(length, FRAMES_PER_EPISODE)).round().astype(int)
        drawn += [start + t for t in frames]
        start += length
    chosen = np.stack(states)[drawn]  # (N, L)
    u, s, _ = np.linalg.svd(chosen - chosen.mean(0), full_matrices=False)
    expected = u[:, :2] * s[:2]  # each component up to its sign
    assert latents.points.shape == expected.shape == (2 * (FRAMES_PER_EPISODE + 6), 2)
    for found, wanted in zip(latents.points.T, expected.T, strict=True):
        np.testing.assert_allclose(np.sort(np.abs(found)), np.sort(np.abs(wanted)), atol=1e-3)
    np.testing.assert_allclose(latents.explained, (s**2 / (s**2).sum())[:2], atol=1e-4)
    assert (latents.n_episodes, latents.n_dims) == (4, 24)


def test_each_point_has_its_task_and_its_time(latents: LatentMap, dataset: LeRobotDataset) -> None:
    assert latents.tasks == ["Reach a goal position", "Push and close a window"]
    assert np.bincount(latents.task).tolist() == [FRAMES_PER_EPISODE + 6] * 2
    assert np.sort(latents.time)[[0, 3, 4, -4, -1]].tolist() == pytest.approx([0, 0, 1 / 51, 1, 1], abs=0.02)
    # Both episodes of a task start from the same variation, so from the same state.
    for task in (0, 1):
        first = latents.points[(latents.task == task) & (latents.time == 0)]
        spread = np.linalg.norm(first[0] - first[1])
        assert spread < 0.05 * np.ptp(latents.points[:, 0])


def test_episodes_of_several_tasks_are_counted_under_one(
    dataset: LeRobotDataset, untrained_path: Path, tmp_path: Path
) -> None:
    """LeRobot lists an episode's tasks in any order: the first of them need not be that of its first frame."""
    root = shutil.copytree(dataset.root, tmp_path / "copy")
    [path] = root.glob("meta/episodes/*/*.parquet")
    table = pq.read_table(path)
    tasks = [["approach", *tasks] for tasks in table["tasks"].to_pylist()]
    pq.write_table(table.set_column(table.column_names.index("tasks"), "tasks", pa.array(tasks)), path)
    copy = LeRobotDataset(dataset.repo_id, root=root)
    found = latent_map(load_world_model(str(untrained_path)), copy.meta, source_of(copy))
    assert found.tasks == ["approach"]
    assert set(found.task.tolist()) == {0}


def test_long_episodes_are_read_to_a_bound(
    dataset: LeRobotDataset, untrained_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    # Whole episodes of ten thousand frames took minutes and gigabytes.
    monkeypatch.setattr("lerobot_wm.inspect.latent_map.MAX_FRAMES", 20)
    policy = load_world_model(str(untrained_path))
    found = latent_map(policy, dataset.meta, source_of(dataset))
    assert found.max_frames == 20
    assert np.bincount(found.task).tolist() == [20 + 6] * 2
    assert found.time.max() == 1


def test_figures_colour_by_task_and_by_time(latents: LatentMap) -> None:
    by_task, by_time = latent_figures(latents)
    points = by_task.axes[0].collections[0]
    np.testing.assert_array_equal(points.get_offsets(), latents.points)
    assert len(np.unique(points.get_facecolors(), axis=0)) == 2
    np.testing.assert_array_equal(by_time.axes[0].collections[0].get_array(), latents.time)
    assert [task for task, _ in latents.legend] == latents.tasks


@pytest.mark.parametrize("n_tasks", [1, 10, 11, 50])
def test_every_task_has_a_colour_of_its_own(n_tasks: int) -> None:
    assert len(set(task_colours(n_tasks))) == n_tasks
