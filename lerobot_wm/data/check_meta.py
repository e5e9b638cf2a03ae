"""The check of a dataset's `info.json`, which may come from anywhere."""

import json
import re
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import pandas as pd
from lerobot.datasets.io_utils import load_info
from lerobot.datasets.utils import DEFAULT_DATA_PATH, DEFAULT_VIDEO_PATH, INFO_PATH, STATS_PATH
from lerobot.utils.constants import DEFAULT_FEATURES

from lerobot_wm.constants import ACTION, OBS_STATE
from lerobot_wm.data.source import DatasetError

MEND = "copy or download the dataset again, whole"

_MAX_NAME = 120  # characters of a feature's name, which becomes part of file names
_MAX_COUNT = 2**53
_CAMERA_DTYPES = ("image", "video")
TEXT_DTYPES = ("string", "language")
_NUMBER = r"\{(?:chunk|file)_index(?::\d{0,2}d)?\}"
_DATA_PATTERN = re.compile(rf"data/(?:[\w.-]|{_NUMBER})+/(?:[\w.-]|{_NUMBER})+\.parquet", re.ASCII)
_VIDEO_PATTERN = re.compile(rf"videos/(?:[\w./-]|{_NUMBER}|\{{video_key\}})+", re.ASCII)


@dataclass(frozen=True)
class Info:
    """What `info.json` says, checked.

    Attributes:
        root: The dataset's folder.
        fps: Frames per second.
        features: dtype, shape and names of each feature.
        total_episodes, total_frames, total_tasks: How many there are, each at least 1.
        data_path, video_path: Patterns of its files, relative to `root` and never out of it.
    """

    root: Path
    fps: float
    features: dict[str, dict[str, Any]]
    total_episodes: int
    total_frames: int
    total_tasks: int
    data_path: str
    video_path: str

    @property
    def video_keys(self) -> list[str]:
        """Cameras that are stored as video."""
        return [key for key, feature in self.features.items() if feature["dtype"] == "video"]

    def tables(self, episodes: pd.DataFrame) -> dict[Path, pd.DataFrame]:
        """The data files in LeRobot's order, and the episodes in each."""
        places = episodes.groupby(["data/chunk_index", "data/file_index"])
        return {
            self.root / self.data_path.format(chunk_index=chunk, file_index=file): rows
            for (chunk, file), rows in places
        }

    def videos(self, camera: str, episodes: pd.DataFrame) -> dict[Path, float]:
        """The video files of a camera, and where in each its last episode ends, in seconds."""
        prefix = f"videos/{camera}"
        places = episodes.groupby([f"{prefix}/chunk_index", f"{prefix}/file_index"])
        return {
            self.root / self.video_path.format(video_key=camera, chunk_index=chunk, file_index=file): float(
                rows[f"{prefix}/to_timestamp"].max()
            )
            for (chunk, file), rows in places
        }


def read_file[T](path: Path, read: Callable[[Path], T]) -> T:
    """Read a file that may be missing or broken.

    Raises:
        DatasetError: It is, whatever the reader makes of it.
    """
    if not path.is_file():
        raise DatasetError(f"{path} is missing: {MEND}. If its recording was broken off, record it again.")
    try:
        return read(path)
    except Exception as error:  # what a reader raises for damaged bytes is not documented
        raise DatasetError(
            f"{path} cannot be read ({one_line(error)}): it was cut short or damaged; {MEND}."
        ) from error


def read_object(path: Path) -> dict[str, Any]:
    """Read a JSON file that holds an object.

    Raises:
        DatasetError: It is missing or broken, or holds anything else.
    """
    content = read_file(path, lambda path: json.loads(path.read_text(encoding="utf-8")))
    if not isinstance(content, dict):
        raise DatasetError(f"{path} holds {shown(content)}; expected an object of names and values: {MEND}.")
    return content


def one_line(error: object) -> str:
    """The beginning of a library's message, on one line and without control characters."""
    text = "".join(letter if letter.isprintable() else " " for letter in str(error))
    return " ".join(text.split())[:160]


def read_info(root: Path) -> Info:
    """Read and check `meta/info.json`.

    Raises:
        DatasetError: Naming the first entry that is not as expected.
    """
    path = root / INFO_PATH
    content = read_object(path)

    def entry(name: str, expected: str, holds: Callable[[Any], bool], default: Any = None) -> Any:
        value = content.get(name, default)
        if not holds(value):
            raise DatasetError(f"{path}: {name} is {shown(value)}; expected {expected}: {MEND}.")
        return value

    def is_count(value: Any) -> bool:
        return type(value) is int and 1 <= value <= _MAX_COUNT

    version = entry("codebase_version", "a version such as v3.0", lambda v: isinstance(v, str))
    if re.fullmatch(r"v3\.\d{1,4}", version) is None:
        raise DatasetError(
            f"{path}: the dataset is of version {shown(version)}; expected v3.0, such as LeRobot 0.6 writes: convert "
            "it with LeRobot's own script."
        )
    info = Info(
        root=root,
        fps=entry("fps", "frames per second", lambda v: type(v) in (int, float) and 0 < v < _MAX_COUNT),
        features=entry("features", "the features by name", lambda v: isinstance(v, dict)),
        total_episodes=entry("total_episodes", "at least 1", is_count),
        total_frames=entry("total_frames", "at least 1", is_count),
        total_tasks=entry("total_tasks", "at least 1", is_count),
        data_path=entry(
            "data_path",
            f"a pattern within data/ such as {DEFAULT_DATA_PATH}",
            lambda v: _fits(_DATA_PATTERN, v),
            DEFAULT_DATA_PATH,
        ),
        video_path=entry(
            "video_path",
            f"a pattern within videos/ such as {DEFAULT_VIDEO_PATH}",
            lambda v: v is None or _fits(_VIDEO_PATTERN, v),
            DEFAULT_VIDEO_PATH,
        )
        or DEFAULT_VIDEO_PATH,
    )
    for name in DEFAULT_FEATURES.keys() | info.features.keys():
        _check_feature(path, name, info.features.get(name))
    read_file(path, lambda path: load_info(root))  # LeRobot has further entries
    return info


def shown(value: object) -> str:
    """A value of an untrusted file for a message: one line, not long."""
    text = ascii(value)
    return text if len(text) <= 80 else f"{text[:80]}..."


def _fits(pattern: re.Pattern[str], value: object) -> bool:
    return isinstance(value, str) and pattern.fullmatch(value) is not None and ".." not in value


def _check_feature(path: Path, name: str, feature: Any) -> None:
    def refuse(what: str) -> DatasetError:
        return DatasetError(f"{path}: feature {shown(name)} {what}: {MEND}.")

    if not 0 < len(name) <= _MAX_NAME or not name.isprintable() or {"/", "\\"} & set(name) or ".." in name:
        raise refuse(
            f"has a name that cannot be part of a file's (1 to {_MAX_NAME} letters, no slash, no '..')"
        )
    if not isinstance(feature, dict):
        raise refuse(
            "is missing" if feature is None else f"is {shown(feature)}; expected dtype, shape and names"
        )
    dtype, shape, names = feature.get("dtype"), feature.get("shape"), feature.get("names")
    camera = dtype in _CAMERA_DTYPES
    if not camera and dtype not in TEXT_DTYPES and not _is_number_type(dtype):
        raise refuse(f"has dtype {shown(dtype)}; expected a type of numbers, image, video or string")
    sizes = shape if isinstance(shape, list) else []
    if not 1 <= len(sizes) <= 5 or not all(type(size) is int and 0 < size < 2**31 for size in sizes):
        raise refuse(f"has shape {shown(shape)}; expected sizes, such as [7]")
    if camera and len(sizes) != 3:
        raise refuse(f"has shape {shown(shape)}; expected sizes, such as [64, 64, 3]")
    if camera and not (
        isinstance(names, list) and len(names) == 3 and all(isinstance(n, str) for n in names)
    ):
        raise refuse(
            f"has names {shown(names)}; expected the image's axes, such as [height, width, channels]"
        )


def _is_number_type(dtype: object) -> bool:
    return (
        isinstance(dtype, str) and re.fullmatch(r"bool|u?int(8|16|32|64)|float(16|32|64)", dtype) is not None
    )


_RECOMPUTE = f"{MEND}, or train on a copy that lerobot-edit-dataset --operation.type=recompute_stats makes"


def check_stats(info: Info) -> None:
    """Check `meta/stats.json`: LeRobot goes on without it, and then nothing scales actions and proprioception.

    Raises:
        DatasetError: It is missing or broken, or lacks finite statistics of the action or proprioception.
    """
    path = info.root / STATS_PATH
    if not path.is_file():
        raise DatasetError(
            f"{path} is missing, which scales actions and proprioception: {_RECOMPUTE}. It has none of images: "
            "train with --dataset.use_imagenet_stats=false, or LeRobot looks for them."
        )
    stats = read_object(path)
    for name, of_feature in stats.items():
        try:
            if not isinstance(of_feature, dict):
                raise TypeError(f"expected statistics by name, found {shown(of_feature)}")
            arrays = {key: np.asarray(value, dtype=np.float64) for key, value in of_feature.items()}
        except (TypeError, ValueError, OverflowError) as error:
            raise DatasetError(
                f"{path}: the statistics of {shown(name)} are no numbers ({one_line(error)}): {MEND}."
            ) from error
        if name in (ACTION, OBS_STATE):
            size = int(np.prod(info.features[name]["shape"])) if name in info.features else 0
            for key in ("min", "max", "mean", "std"):
                if key not in arrays or arrays[key].size != size or not np.isfinite(arrays[key]).all():
                    raise DatasetError(
                        f"{path}: '{key}' of {name} is {shown(of_feature.get(key))}; expected {size} finite numbers, "
                        f"as {name} has in info.json: {_RECOMPUTE}."
                    )
    missing = [name for name in (ACTION, OBS_STATE) if name in info.features and name not in stats]
    if missing:
        raise DatasetError(
            f"{path} has no statistics of {', '.join(missing)}, which scale them: {_RECOMPUTE}."
        )
