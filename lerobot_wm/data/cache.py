"""Camera frames, decoded once at a model's image size into a memory-mapped uint8 file beside the dataset."""

import hashlib
import logging
import os
import shutil
from collections.abc import Iterable, Iterator
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path
from typing import Any

import av
import numpy as np
import torch
from lerobot.datasets.lerobot_dataset import LeRobotDataset
from lerobot.utils.constants import HF_LEROBOT_HOME
from numpy.lib.format import open_memmap
from torch import Tensor
from tqdm import tqdm

from lerobot_wm.data.check import FIX, DatasetError, brief
from lerobot_wm.data.latents import dataset_fingerprint
from lerobot_wm.data.source import is_snapshot
from lerobot_wm.errors import disk_problem
from lerobot_wm.files import appears_whole, sole_writer
from lerobot_wm.nn.images import channels_first, resize_bytes
from lerobot_wm.system import usable_cores

logger = logging.getLogger(__name__)

_VIDEO_CHANNELS = 3
CACHE_VARIABLE = "LEROBOT_WM_CACHE"
_DIGEST_DIGITS = 8

# PNG images that a thread reads at once.
_READ_AT_ONCE = 16
_MAX_THREADS = 16


def cache_root(dataset_root: Path) -> Path:
    """The folder for files derived from a dataset: `<root>.cache` beside it, or a folder in $LEROBOT_WM_CACHE.

    The folder there is named by the dataset's folder and a digest of its whole path.

    For a snapshot in a cache of the Hub it is `$HF_LEROBOT_HOME/lerobot_wm/OWNER--NAME--COMMIT.cache`: beside the
    snapshot, `hf cache prune` would remove it as a snapshot without a branch.

    Decoded frames can be removed at any time. A run that will be resumed needs its latents where they are.

    Raises:
        PermissionError: The folder cannot be written.
    """
    # An absolute path, because `.` has neither a name nor a place beside it.
    dataset_root = Path(os.path.abspath(dataset_root))
    place = os.environ.get(CACHE_VARIABLE)
    if place:
        # Many datasets are in a folder of the same name.
        digest = hashlib.sha256(str(dataset_root.resolve()).encode()).hexdigest()[:_DIGEST_DIGITS]
        root = Path(place).expanduser() / f"{dataset_root.name}-{digest}"
    elif is_snapshot(dataset_root):
        repository = dataset_root.parents[1].name.removeprefix("datasets--")
        root = HF_LEROBOT_HOME / "lerobot_wm" / f"{repository}--{dataset_root.name}.cache"
    else:
        root = dataset_root.with_name(f"{dataset_root.name}.cache")
    try:
        root.mkdir(parents=True, exist_ok=True)
    except OSError as error:
        raise PermissionError(
            f"Cannot write decoded frames to {root} ({error.strerror}): set {CACHE_VARIABLE} to a folder with room for "
            "them."
        ) from error
    return root


class CameraCache:
    """One camera's frames of the whole dataset, (N, H, W, C) uint8, by absolute frame index.

    Episodes are decoded on first use and each is marked once its frames are on disk, so that an interrupted decoding
    resumes, and a dataset opened for some episodes decodes only those.

    Args:
        dataset: The dataset.
        key: The camera.
        folder: Folder of the cache; it has one file per camera and size.
        size: (H, W) that frames are resized to; None keeps their size.
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
        """The memory map, (N, H, W, C) uint8; frames of episodes that were never decoded are zero."""
        return self._frames

    def ensure(self, episodes: Iterable[int]) -> None:
        """Decode episodes that are not in the cache yet, on up to 16 cores.

        Raises:
            OSError: The frames do not fit on the disk.
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
        # Writing to a memory map on a full disk raises no error but kills the process.
        lengths = self._dataset.meta.episodes["length"][:]
        needed = sum(lengths[episode] for episode in episodes) * self._frames[0].nbytes
        free = shutil.disk_usage(self._folder).free
        if needed > free:
            raise OSError(
                f"The decoded frames of {self._key} need {needed / 1e9:.1f} GB, but {self._folder} has "
                f"{free / 1e9:.1f} GB free: make room there, or set {CACHE_VARIABLE} to a folder on a larger disk."
            )

    def _decode(self, episode: int) -> None:
        row = self._dataset.meta.episodes[episode]
        size = self._frames.shape[1:3]
        position = row["dataset_from_index"]
        self._reserve(position, row["length"])
        try:
            # One by one, as a frame fits into the processor's cache.
            for image in self._images(row):
                if image.shape[-2:] != size:
                    image = resize_bytes(image[None], size)[0]
                self._frames[position] = image.permute(1, 2, 0).numpy()
                position += 1
        except Exception as error:  # decoders do not document what they raise for damaged files
            if disk_problem(error) is not None:
                raise
            raise DatasetError(
                f"{self._file(episode)}: the images of {self._key} in episode {episode} cannot be decoded "
                f"({brief(error)}): the file is damaged; {FIX}."
            ) from error
        self._frames.flush()
        self._decoded[episode] = 1

    def _reserve(self, position: int, length: int) -> None:
        """Reserve an episode's place on the disk, which others may have filled since the check for room."""
        if not hasattr(os, "posix_fallocate"):  # macOS
            return
        frame_bytes = self._frames[0].nbytes
        start = self._frames.offset + position * frame_bytes
        with self._path.open("r+b") as file:
            try:
                os.posix_fallocate(file.fileno(), start, length * frame_bytes)
            except OSError as error:
                error.filename = str(self._path)
                raise

    def _file(self, episode: int) -> Path:
        meta, root = self._dataset.meta, Path(self._dataset.root)
        if self._key in meta.video_keys:
            return root / meta.get_video_file_path(episode, self._key)
        return root / meta.get_data_file_path(episode)

    def _images(self, row: dict[str, Any]) -> Iterator[Tensor]:
        """An episode's stored frames, each (C, H, W) uint8."""
        meta = self._dataset.meta
        start, stop = row["dataset_from_index"], row["dataset_to_index"]
        if self._key in meta.video_keys:
            first = row[f"videos/{self._key}/from_timestamp"]
            times = [first + i / meta.fps for i in range(stop - start)]
            yield from _video_frames(self._file(row["episode_index"]), times, tolerance=1 / (4 * meta.fps))
            return
        relative = self._dataset.absolute_to_relative_idx
        # Images of other columns are not decoded.
        column = self._dataset.hf_dataset.select_columns(self._key)
        for position in range(start, stop, _READ_AT_ONCE):
            first = position if relative is None else relative[position]
            for image in column[first : first + min(_READ_AT_ONCE, stop - position)][self._key]:
                yield (image * 255).round().to(torch.uint8)

    @staticmethod
    def _open(path: Path, shape: tuple[int, ...]) -> np.memmap:
        if not path.is_file():
            # Several processes may open the cache at once; all must write into the same file.
            with sole_writer(path, wait=True):
                if not path.is_file():
                    with appears_whole(path) as temporary:
                        open_memmap(temporary, mode="w+", dtype=np.uint8, shape=shape).flush()
        return open_memmap(path, mode="r+")


def _video_frames(path: Path, times: list[float], tolerance: float) -> Iterator[Tensor]:
    """The frames of a video at these times, each (C, H, W) uint8.

    Args:
        path: The video.
        times: In seconds, ascending; further apart than twice the tolerance.
        tolerance: How far a frame's own time may be from the one asked for, in seconds.

    Raises:
        ValueError: The video has no frame at one of these times.
    """
    with av.open(str(path)) as container:
        stream = container.streams.video[0]
        # Episodes are decoded side by side: threads of the decoder would wait for each other.
        stream.codec_context.thread_count = 1
        assert stream.time_base is not None  # videos have one
        seconds = float(stream.time_base)
        container.seek(round(times[0] / seconds) - 1, stream=stream)
        found = 0
        for frame in container.decode(stream):
            if frame.pts is not None and abs(frame.pts * seconds - times[found]) < tolerance:
                yield torch.from_numpy(frame.to_ndarray(format="rgb24")).permute(2, 0, 1)
                found += 1
                if found == len(times):
                    return
    raise ValueError(f"it has no frame at {times[found]:.3f} s")


def check_colours(dataset: LeRobotDataset, keys: Iterable[str]) -> None:
    """Check that cameras show colours, not depth, and that videos have three channels, as decoding assumes.

    Raises:
        ValueError: A camera differs.
    """
    keys = list(keys)
    depth = [key for key in keys if key in dataset.meta.depth_keys]
    if depth:
        raise ValueError(
            f"{dataset.repo_id} has depth cameras ({', '.join(depth)}), but models here see colours, 0 to 255. Choose "
            "other cameras with --policy.image_key, or remove the depth cameras with lerobot-edit-dataset."
        )
    for key in set(keys) & set(dataset.meta.video_keys):
        channels = frame_shape(dataset.meta.features[key])[2]
        if channels != _VIDEO_CHANNELS:
            raise ValueError(
                f"{dataset.repo_id} has videos with {channels} channels of {key}, but models here take "
                f"{_VIDEO_CHANNELS}: red, green and blue. Choose other cameras with --policy.image_key, or record grey "
                "frames with three equal channels."
            )


def frame_shape(feature: dict[str, Any]) -> tuple[int, int, int]:
    """(H, W, C) of a camera's frames, whatever names its axes have.

    Args:
        feature: The camera's entry in a dataset's `features`.
    """
    channels, height, width = channels_first(feature["shape"])
    return height, width, channels


def camera_frames(dataset: LeRobotDataset, key: str, size: tuple[int, int] | None = None) -> Tensor:
    """A camera's decoded frames, memory-mapped: (N, H, W, C) uint8, by absolute frame index.

    Frames of episodes outside `dataset.episodes` are zero unless an earlier call decoded them.

    Args:
        dataset: The dataset.
        key: The camera.
        size: (H, W) that frames are resized to when they are decoded; None keeps their size.

    Raises:
        ValueError: It is a depth camera, or its videos do not have three channels.
    """
    check_colours(dataset, [key])
    folder = cache_root(Path(dataset.root)) / f"frames-{dataset_fingerprint(Path(dataset.root))}"
    if not folder.is_dir():
        if earlier := sorted(folder.parent.glob("frames-*")):
            logger.warning(
                "The dataset has changed: its frames are decoded again. Remove frames of earlier versions that no run "
                "reads any more: %s.",
                ", ".join(map(str, earlier)),
            )
        folder.mkdir(exist_ok=True)
    cache = CameraCache(dataset, key, folder, size)
    cache.ensure(range(dataset.meta.total_episodes) if dataset.episodes is None else dataset.episodes)
    return torch.from_numpy(cache.frames)
