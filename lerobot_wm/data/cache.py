"""Camera frames decoded once, at a model's image size, into uint8 and memory-mapped from a file beside the dataset."""

import logging
import math
import os
import shutil
from collections.abc import Iterable, Iterator
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path
from typing import Any

import numpy as np
import torch
from lerobot.datasets.lerobot_dataset import LeRobotDataset
from lerobot.datasets.video_utils import decode_video_frames
from lerobot.utils.constants import HF_LEROBOT_HOME
from numpy.lib.format import open_memmap
from torch import Tensor
from tqdm import tqdm

from lerobot_wm.data.check_meta import MEND, one_line
from lerobot_wm.data.latents import dataset_fingerprint
from lerobot_wm.data.source import DatasetError, is_snapshot
from lerobot_wm.nn.images import resize_images
from lerobot_wm.system import usable_cores

logger = logging.getLogger(__name__)

_VIDEO_CHANNELS = 3
CACHE_VARIABLE = "LEROBOT_WM_CACHE"

# Of frames that each thread holds at once: bounds memory for long episodes of large images.
_CHUNK_BYTES = 2**25
_RESIZED_AT_ONCE = 8  # frames, which are four times as large then
_MAX_THREADS = 16  # each of which holds a chunk two or three times


def cache_root(dataset_root: Path) -> Path:
    """Where what is derived from a dataset lives: `<root>.cache` beside it, or under $LEROBOT_WM_CACHE.

    Of a snapshot in a cache of the Hub, `$HF_LEROBOT_HOME/lerobot_wm/OWNER--NAME--COMMIT.cache`: beside it, `hf cache
    prune` would take it for a snapshot that no branch leads to, and remove it.

    Decoded frames are made again when needed. The latents of a training are too when it is started anew, but one that
    is to be resumed needs them where they are.

    Raises:
        PermissionError: The place cannot be written.
    """
    dataset_root = Path(os.path.abspath(dataset_root))  # of `.` the name, and what is beside it
    place = os.environ.get(CACHE_VARIABLE)
    if place:
        root = Path(place) / dataset_root.name
    elif is_snapshot(dataset_root):
        repository = dataset_root.parents[1].name.removeprefix("datasets--")
        root = HF_LEROBOT_HOME / "lerobot_wm" / f"{repository}--{dataset_root.name}.cache"
    else:
        root = dataset_root.with_name(f"{dataset_root.name}.cache")
    try:
        root.mkdir(parents=True, exist_ok=True)
    except OSError as error:
        raise PermissionError(
            f"Cannot write the decoded frames to {root} ({error.strerror}): "
            f"set {CACHE_VARIABLE} to a folder with room for them."
        ) from error
    return root


class CameraCache:
    """One camera's frames for the whole dataset, (N, H, W, C) uint8 in order of the absolute frame index.

    Episodes are decoded on first use, and each is marked when its frames are on disk: an interrupted decoding
    goes on where it stopped, and a dataset opened for some episodes decodes only those.

    Args:
        dataset: The dataset.
        key: The camera.
        folder: Where its file lies; each size has one.
        size: (H, W) that frames are resized to; None leaves them.
    """

    def __init__(
        self, dataset: LeRobotDataset, key: str, folder: Path, size: tuple[int, int] | None = None
    ) -> None:
        self._dataset = dataset
        self._key = key
        self._folder = folder
        height, width, channels = frame_shape(dataset.meta.features[key])
        name = key
        if size not in (None, (height, width)):
            name = f"{key}-{size[0]}x{size[1]}"
            height, width = size
        shape = (dataset.meta.total_frames, height, width, channels)
        self._path = folder / f"{name}.npy"
        self._frames = self._open(self._path, shape)
        self._decoded = self._open(folder / f"{name}.decoded.npy", (dataset.meta.total_episodes,))

    @property
    def frames(self) -> np.ndarray:
        """The memory map, (N, H, W, C) uint8; only episodes that were asked for hold frames."""
        return self._frames

    def ensure(self, episodes: Iterable[int]) -> None:
        """Decode the episodes that are not in the cache yet, on up to 16 cores.

        Raises:
            OSError: Their frames do not fit on the disk.
            DatasetError: A file is damaged.
        """
        missing = [episode for episode in episodes if not self._decoded[episode]]
        if not missing:
            return
        self._check_room(missing)
        with ThreadPoolExecutor(min(usable_cores(), _MAX_THREADS)) as pool:
            done = pool.map(self._decode, missing)
            list(tqdm(done, total=len(missing), desc=f"Decoding {self._key}", unit="episode", leave=False))

    def _check_room(self, episodes: list[int]) -> None:
        # A write through a memory map that finds the disk full does not raise: it kills the process.
        lengths = self._dataset.meta.episodes["length"][:]
        needed = sum(lengths[episode] for episode in episodes) * self._frames[0].nbytes
        free = shutil.disk_usage(self._folder).free
        if needed > free:
            raise OSError(
                f"The decoded frames of {self._key} take {needed / 1e9:.1f} GB, and {self._folder} has "
                f"{free / 1e9:.1f} GB free: make room there, or set {CACHE_VARIABLE} to a folder on a larger disk."
            )

    def _decode(self, episode: int) -> None:
        row = self._dataset.meta.episodes[episode]
        size = self._frames.shape[1:3]
        position = row["dataset_from_index"]
        self._reserve(position, row["length"])
        try:
            for images in self._images(row):
                for part in images.split(_RESIZED_AT_ONCE):
                    if part.shape[-2:] != size:
                        part = (resize_images(part.float() / 255, size) * 255).round().to(torch.uint8)
                    self._frames[position : position + len(part)] = part.permute(0, 2, 3, 1).numpy()
                    position += len(part)
        except Exception as error:  # what decoders raise for damaged bytes is not documented
            raise DatasetError(
                f"{self._file(episode)}: the images of {self._key} in episode {episode} cannot be decoded "
                f"({one_line(error)}): the file is damaged; {MEND}."
            ) from error
        self._frames.flush()
        self._decoded[episode] = 1

    def _reserve(self, position: int, length: int) -> None:
        """Have the disk set aside the place of an episode: others may have filled it since there was room for all."""
        if not hasattr(os, "posix_fallocate"):  # macOS
            return
        frame_bytes = self._frames[0].nbytes
        start = self._frames.offset + position * frame_bytes
        with self._path.open("r+b") as file:
            try:
                os.posix_fallocate(file.fileno(), start, length * frame_bytes)
            except OSError as error:
                error.filename = str(self._path)  # which the system does not know
                raise

    def _file(self, episode: int) -> Path:
        meta, root = self._dataset.meta, Path(self._dataset.root)
        if self._key in meta.video_keys:
            return root / meta.get_video_file_path(episode, self._key)
        return root / meta.get_data_file_path(episode)

    def _images(self, row: dict[str, Any]) -> Iterator[Tensor]:
        """An episode's frames as they are stored, some at a time: (T, C, H, W) uint8."""
        meta = self._dataset.meta
        start, stop = row["dataset_from_index"], row["dataset_to_index"]
        count = max(1, _CHUNK_BYTES // math.prod(frame_shape(meta.features[self._key])))
        if self._key in meta.video_keys:
            first = row[f"videos/{self._key}/from_timestamp"]
            for position in range(0, stop - start, count):
                # Not by torchcodec, for which LeRobot keeps one decoder per file, and other threads read the same file.
                yield decode_video_frames(
                    self._file(row["episode_index"]),
                    [first + i / meta.fps for i in range(position, min(position + count, stop - start))],
                    tolerance_s=1 / (4 * meta.fps),
                    backend="pyav",
                    return_uint8=True,
                )
            return
        relative = self._dataset.absolute_to_relative_idx
        column = self._dataset.hf_dataset.select_columns(self._key)  # other cameras' images stay undecoded
        for position in range(start, stop, count):
            first = position if relative is None else relative[position]
            rows = column[first : first + min(count, stop - position)][self._key]
            yield (torch.stack(rows) * 255).round().to(torch.uint8)

    @staticmethod
    def _open(path: Path, shape: tuple[int, ...]) -> np.memmap:
        if path.is_file():
            return open_memmap(path, mode="r+")
        partial = path.with_suffix(f".{os.getpid()}.tmp")
        try:
            open_memmap(partial, mode="w+", dtype=np.uint8, shape=shape).flush()
            # A hard link, not a rename: where another process was faster its file stays, and both write into that one.
            try:
                os.link(partial, path)
            except FileExistsError:
                pass
            except OSError:  # exFAT and some file systems of the network know no links
                partial.replace(path)
        finally:
            partial.unlink(missing_ok=True)
        return open_memmap(path, mode="r+")


def _tell_of_earlier_frames(folder: Path) -> None:
    """Say that frames of other versions of the dataset lie beside: nobody else removes them."""
    earlier = sorted(folder.parent.glob("frames-*"))
    if earlier:
        logger.warning(
            "The dataset has changed: its frames are decoded anew. Remove those of earlier versions, %s, where no "
            "training reads them any more.",
            ", ".join(map(str, earlier)),
        )


def check_colours(dataset: LeRobotDataset, keys: Iterable[str]) -> None:
    """Refuse cameras whose pixels are distances, and videos of anything but three colours, which is what is decoded.

    Raises:
        ValueError: Some of the keys are such cameras.
    """
    keys = list(keys)
    depth = [key for key in keys if key in dataset.meta.depth_keys]
    if depth:
        raise ValueError(
            f"{dataset.repo_id} has depth cameras, {', '.join(depth)}; models here see colours, 0 to 255. Choose the "
            "others with --policy.image_key, or remove these with lerobot-edit-dataset."
        )
    for key in set(keys) & set(dataset.meta.video_keys):
        channels = frame_shape(dataset.meta.features[key])[2]
        if channels != _VIDEO_CHANNELS:
            raise ValueError(
                f"{dataset.repo_id} has videos of {channels} channels of {key}; models here take videos of "
                f"{_VIDEO_CHANNELS}, red, green and blue. Choose the others with --policy.image_key, or record grey "
                "frames with three channels that are equal."
            )


def frame_shape(feature: dict[str, Any]) -> tuple[int, int, int]:
    """(H, W, C) of a camera's frames, from its entry in a dataset's `features`."""
    shape = tuple(feature["shape"])
    return shape if feature["names"][2].startswith("channel") else (*shape[1:], shape[0])


def camera_frames(dataset: LeRobotDataset, key: str, size: tuple[int, int] | None = None) -> Tensor:
    """A camera's decoded frames, (N, H, W, C) uint8 by absolute index, memory-mapped.

    Frames of episodes outside `dataset.episodes` are zero unless an earlier call decoded them.

    Args:
        dataset: The dataset.
        key: The camera.
        size: (H, W) that frames are resized to, once; None leaves them as they are in the dataset.

    Raises:
        ValueError: It is a depth camera, or has videos that are not in three colours.
    """
    check_colours(dataset, [key])
    folder = cache_root(Path(dataset.root)) / f"frames-{dataset_fingerprint(Path(dataset.root))}"
    if not folder.is_dir():
        _tell_of_earlier_frames(folder)
        folder.mkdir(exist_ok=True)
    cache = CameraCache(dataset, key, folder, size)
    cache.ensure(range(dataset.meta.total_episodes) if dataset.episodes is None else dataset.episodes)
    return torch.from_numpy(cache.frames)
