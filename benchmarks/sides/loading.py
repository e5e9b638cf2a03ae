"""The same batches from LeRobot's DataLoader and from ours."""

from collections.abc import Iterator
from pathlib import Path

import torch
from lerobot.datasets.lerobot_dataset import LeRobotDataset
from lerobot.datasets.sampler import EpisodeAwareSampler
from torch.utils.data import BatchSampler, DataLoader

from benchmarks.data import REPO_ID, demonstrations, latents
from benchmarks.timing import Prepared, rate
from lerobot_wm.constants import ACTION, FPS, OBS_IMAGE, OBS_LATENT, OBS_STATE, REWARD
from lerobot_wm.data.loader import EpochOrder, RamLoader
from lerobot_wm.system import keep_freed_memory

CPU = torch.device("cpu")


def ram_windows(
    folder: Path, episodes_per_task: int, batch: int, length: int, workers: int, seconds: float
) -> Prepared:
    """Time windows from RAM, which needs no workers."""
    loader = _in_ram(_windows(folder, episodes_per_task, batch, length, workers))
    return _prepared(loader, workers, seconds, per_batch=batch)


def lerobot_windows(
    folder: Path, episodes_per_task: int, batch: int, length: int, workers: int, seconds: float
) -> Prepared:
    """Time windows from LeRobot's loader."""
    loader = _windows(folder, episodes_per_task, batch, length, workers)
    return _prepared(loader, workers, seconds, per_batch=batch)


def ram_latents(folder: Path, episodes_per_task: int, batch: int, workers: int, seconds: float) -> Prepared:
    """Time batches of latent transitions from RAM."""
    return _prepared(_in_ram(_transitions(folder, episodes_per_task, batch, workers)), workers, seconds)


def lerobot_latents(
    folder: Path, episodes_per_task: int, batch: int, workers: int, seconds: float
) -> Prepared:
    """Time batches of latent transitions from LeRobot's loader."""
    return _prepared(_transitions(folder, episodes_per_task, batch, workers), workers, seconds)


def _windows(folder: Path, episodes_per_task: int, batch: int, length: int, workers: int) -> DataLoader:
    """Make LeRobot's loader as `lerobot-train --policy.type=wm_rssm` does."""
    deltas = [i / FPS for i in range(length)]
    dataset = LeRobotDataset(
        REPO_ID,
        root=demonstrations(folder, episodes_per_task),
        delta_timestamps=dict.fromkeys((OBS_IMAGE, OBS_STATE, ACTION, REWARD), deltas),
        return_uint8=True,
    )
    return _loader(dataset, batch, workers, drop_n_last_frames=length - 1)


def _transitions(folder: Path, episodes_per_task: int, batch: int, workers: int) -> DataLoader:
    """Make LeRobot's loader as `lerobot-train --policy.type=wm_iql` does."""
    root, _ = latents(folder, episodes_per_task)
    deltas = {key: [0.0, 1 / FPS] for key in (OBS_LATENT, OBS_STATE)}
    return _loader(LeRobotDataset(REPO_ID, root=root, delta_timestamps=deltas), batch, workers)


class _Endless:
    """A sampler's epochs in a row, because `lerobot-train` too keeps its workers between epochs."""

    def __init__(self, sampler: EpisodeAwareSampler | EpochOrder) -> None:
        self.sampler = sampler

    def __iter__(self) -> Iterator[int]:
        while True:
            yield from self.sampler


def _loader(dataset: LeRobotDataset, batch: int, workers: int, drop_n_last_frames: int = 0) -> DataLoader:
    episodes = dataset.meta.episodes
    sampler = EpisodeAwareSampler(
        episodes["dataset_from_index"],
        episodes["dataset_to_index"],
        drop_n_last_frames=drop_n_last_frames,
        shuffle=True,
    )
    # Prefetch as lerobot-train does.
    return DataLoader(dataset, batch, sampler=_Endless(sampler), num_workers=workers, prefetch_factor=4)


def _in_ram(loader: DataLoader) -> RamLoader:
    # As in `lerobot-wm train`: without it, how long a batch takes depends on what the process allocated before.
    keep_freed_memory()
    # The same samples in the same order, looked up epoch by epoch as in `lerobot-wm train`.
    assert isinstance(loader.sampler, _Endless)
    assert isinstance(loader.sampler.sampler, EpisodeAwareSampler)
    assert loader.batch_size is not None
    order = _Endless(EpochOrder(loader.sampler.sampler))
    return RamLoader(loader, BatchSampler(order, loader.batch_size, drop_last=False), CPU)


def _prepared(loader: DataLoader | RamLoader, workers: int, seconds: float, per_batch: int = 1) -> Prepared:
    def measure() -> float:
        # New workers each time, so that no queue fills before the measurement. They deliver at about the same time,
        # so count whole rounds, starting at the end of the first.
        batches = iter(loader)

        def draw_round() -> int:
            for _ in range(workers):
                next(batches)
            return workers * per_batch

        draw_round()
        return rate(draw_round, seconds)

    return Prepared(measure)
