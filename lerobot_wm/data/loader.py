"""Batches equal to LeRobot's DataLoader, gathered from RAM or GPU memory; images at the size a policy takes."""

import logging
from collections.abc import Iterable, Iterator, Mapping, Sequence
from typing import Any

import numpy as np
import torch
from lerobot.datasets.lerobot_dataset import LeRobotDataset
from lerobot.datasets.sampler import EpisodeAwareSampler
from torch import Tensor
from torch.utils.data import BatchSampler, DataLoader, Subset

from lerobot_wm.data.cache import camera_frames, check_colours
from lerobot_wm.data.tables import TEXT_DTYPES, check_finite_columns, column_tensor


class EpochOrder:
    """Yields what a shuffling `EpisodeAwareSampler` yields, in the same order, and moves it on by the same epochs.

    The sampler searches each sample's episode in Python, which for a batch of latents takes longer than gathering it.
    """

    def __init__(self, sampler: EpisodeAwareSampler) -> None:
        self._sampler = sampler
        self._rows = torch.tensor(sampler.indices)  # (N,) dataset row of each position of the sampler

    def __iter__(self) -> Iterator[int]:
        state = self._sampler.state_dict()
        self._sampler.load_state_dict({"epoch": state["epoch"] + 1, "start_index": 0})
        # The sampler documents its order as a function of its seed and the epoch.
        seed = np.random.SeedSequence([self._sampler.seed, state["epoch"]]).generate_state(1, np.uint64)[0]
        order = torch.randperm(len(self._rows), generator=torch.Generator().manual_seed(int(seed)))
        return iter(self._rows[order[state["start_index"] :]].tolist())

    def __len__(self) -> int:
        return len(self._rows)


def batches_of_rows(data_loader: DataLoader) -> Any:
    """The batch sampler of a loader that LeRobot built, or a faster one of the same batches."""
    sampler = data_loader.sampler
    if not (isinstance(sampler, EpisodeAwareSampler) and sampler.shuffle):
        return data_loader.batch_sampler
    size = data_loader.batch_size
    assert size is not None  # LeRobot's loaders batch
    return BatchSampler(EpochOrder(sampler), size, data_loader.drop_last)


logger = logging.getLogger(__name__)

_COPIED_AT_ONCE = 1024  # frames
_GPU_SHARE = 0.6  # of the free GPU memory may be taken by resident frames; activations need the rest


def gather(source: Tensor, index: Tensor) -> Tensor:
    """source[index] for index (B,) or (B, T), copied row by row: on a CPU four to twenty times faster than indexing."""
    return source.index_select(0, index.flatten()).unflatten(0, index.shape)


class RamDataset:
    """A LeRobotDataset's columns and decoded frames as tensors, indexed as the dataset is.

    Args:
        dataset: The dataset, with the delta indices it was opened with.
        device: Frames are kept here when they fit, else in a memory map; the columns always are.
        cameras: Those to decode and serve, each with the (H, W) its images are brought to; None for all of the dataset,
            as they are.

    Raises:
        ValueError: The dataset applies image transforms, which decoded frames do not go through, or has depth cameras.
        DatasetError: An observation, action or reward is not finite.
    """

    def __init__(
        self,
        dataset: LeRobotDataset,
        device: torch.device,
        cameras: Mapping[str, tuple[int, int]] | None = None,
    ) -> None:
        if dataset.image_transforms is not None:
            raise ValueError(
                "--dataset.image_transforms.enable=true has no effect on frames served from RAM: "
                "turn it off, or train with lerobot-train."
            )
        self.device = device
        meta = dataset.meta
        check_colours(dataset, meta.camera_keys if cameras is None else cameras)
        self._tasks = [str(task) for task in meta.tasks.index]
        self._deltas = {key: tuple(deltas) for key, deltas in (dataset.reader.delta_indices or {}).items()}
        self._offsets = {deltas: torch.tensor(deltas, device=device) for deltas in self._deltas.values()}
        kinds = {key: feature["dtype"] for key, feature in meta.features.items()}
        self._columns = {
            key: column_tensor(dataset.hf_dataset, key, tuple(meta.features[key]["shape"])).to(device)
            for key, kind in kinds.items()
            if key not in meta.camera_keys and kind not in TEXT_DTYPES
        }
        # LeRobot's collation drops columns of its type "language".
        self._texts = {
            key: list(dataset.hf_dataset.with_format(None)[key])
            for key, kind in kinds.items()
            if kind == "string"
        }
        check_finite_columns(self._columns, meta)
        # On the CPU: a GPU's would be waited for at each batch.
        self._task_of_row: list[int] = self._columns["task_index"].tolist()
        # PNG frames leave LeRobot's loader as float32, video frames as uint8 for the training loop to convert.
        self._float_cameras = set(meta.image_keys)
        self._cameras = {
            key: camera_frames(dataset, key, None if cameras is None else cameras[key])
            for key in meta.camera_keys
            if cameras is None or key in cameras
        }
        # (N,), which is no row's number where episodes were chosen.
        self._frame_of_row = self._columns["index"]
        if self._fit_on_device():
            self._move_frames()

        episode = self._columns["episode_index"]
        starts = torch.searchsorted(episode, episode)  # rows of an episode are consecutive
        stops = torch.searchsorted(episode, episode, right=True)
        self._first, self._last = starts, stops - 1  # (N,) per row: first and last row of its episode

    def batch(self, rows: list[int]) -> dict[str, Any]:
        """The collated batch of these dataset indices: LeRobot's keys, shapes, types and values."""
        index = torch.tensor(rows, device=self.device)  # (B,)
        windows: dict[tuple[int, ...], tuple[Tensor, Tensor]] = {}
        out: dict[str, Any] = {}
        for key in (*self._columns, *self._cameras):
            window, is_pad = index, None
            if key in self._deltas:
                deltas = self._deltas[key]
                if deltas not in windows:
                    windows[deltas] = self._window(index, deltas)
                window, is_pad = windows[deltas]
            if is_pad is not None:
                out[f"{key}_is_pad"] = is_pad
            out[key] = (
                self._images(key, window) if key in self._cameras else gather(self._columns[key], window)
            )
        for key, texts in self._texts.items():
            out[key] = [texts[row] for row in rows]
        out["task"] = [self._tasks[self._task_of_row[row]] for row in rows]
        return out

    def _window(self, index: Tensor, deltas: tuple[int, ...]) -> tuple[Tensor, Tensor]:
        """Rows (B, T) around each index, clamped to its episode, and where they were clamped (B, T)."""
        wanted = index[:, None] + self._offsets[deltas]
        clamped = wanted.clamp(self._first[index][:, None], self._last[index][:, None])
        return clamped, wanted != clamped

    def _images(self, key: str, rows: Tensor) -> Tensor:
        """Frames (B, C, H, W) or (B, T, C, H, W): a channels-first view of channels-last memory."""
        frames = self._cameras[key]
        images = gather(frames, self._frame_of_row[rows].to(frames.device)).to(self.device)
        images = images.movedim(-1, -3)
        return images.float() / 255 if key in self._float_cameras else images

    def _fit_on_device(self) -> bool:
        if self.device.type != "cuda":
            return False
        free, _ = torch.cuda.mem_get_info(self.device)
        n_bytes = sum(len(self._frame_of_row) * frames[0].numel() for frames in self._cameras.values())
        return n_bytes < _GPU_SHARE * free

    def _move_frames(self) -> None:
        """Keep the frames on the device, unless others have taken its memory since there was room."""
        try:
            self._cameras = {key: self._on_device(frames) for key, frames in self._cameras.items()}
        except torch.OutOfMemoryError:
            logger.warning(
                "The GPU's memory was taken meanwhile: frames are served from RAM, which is slower."
            )
            torch.cuda.empty_cache()
            return
        self._frame_of_row = torch.arange(len(self._frame_of_row), device=self.device)

    def _on_device(self, frames: Tensor) -> Tensor:
        """The frames of this dataset's own episodes in the device's memory, (N, H, W, C) uint8 by row."""
        resident = frames.new_empty((len(self._frame_of_row), *frames.shape[1:]), device=self.device)
        for part, index in zip(
            resident.split(_COPIED_AT_ONCE), self._frame_of_row.cpu().split(_COPIED_AT_ONCE), strict=True
        ):
            part.copy_(gather(frames, index))
        return resident


class RamLoader:
    """Stands in for a DataLoader: the same batches in the same order, without its workers and copies.

    Args:
        data_loader: The loader LeRobot built; its batch sampler gives the order, its dataset the frames.
        batch_sampler: What to iterate in its place, e.g. this process's share of it.
        device: Where batches are put.
        cameras: Those to serve, see `RamDataset`.
    """

    def __init__(
        self,
        data_loader: DataLoader,
        batch_sampler: Iterable[list[int]],
        device: torch.device,
        cameras: Mapping[str, tuple[int, int]] | None = None,
    ) -> None:
        dataset: Any = data_loader.dataset
        self._subset: Sequence[int] | None = None
        if isinstance(dataset, Subset):  # LeRobot's --max_eval_samples
            dataset, self._subset = dataset.dataset, dataset.indices
        self._batch_sampler = batch_sampler
        self._source = RamDataset(dataset, device, cameras)

    def __iter__(self) -> Iterator[dict[str, Any]]:
        for rows in self._batch_sampler:
            yield self._source.batch(rows if self._subset is None else [self._subset[i] for i in rows])

    def __len__(self) -> int:
        return len(self._batch_sampler)  # type: ignore[arg-type]
