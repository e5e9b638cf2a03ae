"""The check of a dataset's videos by their headers; nothing is decoded."""

from pathlib import Path

import av
import numpy as np
import pandas as pd
from lerobot.datasets.utils import EPISODES_DIR

from lerobot_wm.data.check_info import MEND, Info, read_file
from lerobot_wm.data.errors import DatasetError

_FPS_TOLERANCE = 0.01  # relative: headers round


def check_video_times(info: Info, camera: str, episodes: pd.DataFrame) -> None:
    """Check that each episode takes as long in a camera's video as its frames do, give or take one.

    Raises:
        DatasetError: The frame rate in info.json or the table of episodes is wrong.
    """
    first, last = (episodes[f"videos/{camera}/{name}_timestamp"].to_numpy() for name in ("from", "to"))
    frames = (last - first) * info.fps
    wrong = np.flatnonzero(~(np.abs(frames - episodes["length"].to_numpy()) < 1.5))
    if len(wrong):
        row = wrong[0]
        raise DatasetError(
            f"{info.root / EPISODES_DIR}: episode {row} has {episodes['length'][row]} frames and takes "
            f"{last[row] - first[row]:.2f} s of {camera}'s video, {frames[row]:.1f} frames at the {info.fps:g} per "
            f"second of info.json: set fps there to what it was recorded at, or {MEND}."
        )


def check_video_file(info: Info, camera: str, path: Path, seconds: float) -> None:
    """Check a video: is it whole, of this camera's size and rate, and long enough for its episodes?

    Args:
        info: The dataset's.
        camera: The feature.
        path: The file.
        seconds: Where its last episode ends.

    Raises:
        DatasetError: It is not.
    """
    missing = read_file(path, _bytes_missing)
    if missing:
        raise DatasetError(f"{path} lacks its last {missing} bytes: it was cut short; {MEND}.")
    frames, rate, size = read_file(path, _header)
    feature = info.features[camera]
    shape = dict(zip(feature["names"], feature["shape"], strict=True))
    expected = shape.get("width", size[0]), shape.get("height", size[1])
    if size != expected:
        raise DatasetError(
            f"{path} has images of {size[0]}x{size[1]}, info.json says {expected[0]}x{expected[1]}: it is another "
            f"camera's or dataset's; {MEND}."
        )
    if abs(rate - info.fps) > _FPS_TOLERANCE * info.fps:
        raise DatasetError(
            f"{path} has {rate:g} frames per second, info.json says {info.fps:g}: it is another dataset's, or fps is "
            f"wrong; {MEND}."
        )
    needed = round(seconds * info.fps)
    if frames < needed:
        raise DatasetError(
            f"{path} has {frames} frames, its episodes take {needed}: it is another one's, or was cut short; {MEND}."
        )


def _header(path: Path) -> tuple[int, float, tuple[int, int]]:
    """Number of frames, frames per second, (width, height)."""
    with av.open(str(path)) as container:
        stream = container.streams.video[0]
        if stream.average_rate is None:
            raise ValueError("it names no frame rate")
        header = stream.frames, float(stream.average_rate), (stream.width, stream.height)
    return header


def _bytes_missing(path: Path) -> int:
    """How many bytes an MP4 file's last box promises beyond the end of the file; 0 for other formats.

    FFmpeg opens a file that was cut short behind its header, and the frames are missed only in decoding.
    """
    size = path.stat().st_size
    position = 0
    with path.open("rb") as file:
        while position < size:
            file.seek(position)
            header = file.read(16)
            length = int.from_bytes(header[:4])
            if position == 0 and header[4:8] != b"ftyp":
                return 0
            if length == 1:  # a box of more than 4 GB: its length follows
                length = int.from_bytes(header[8:16])
            if length == 0:  # to the end of the file
                return 0
            if length < 8:
                raise ValueError("a box of less than its own header")
            position += length
    return position - size
