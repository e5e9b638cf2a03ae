"""Is a dataset on this machine whole? Asked before any work.

LeRobot would ask the Hub for what is missing, and find out late about the rest. Metadata is read, the columns that
number the frames, and the headers of videos; no image is decoded.
"""

from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

from datasets.exceptions import DatasetGenerationError
from huggingface_hub.utils import validate_repo_id

from lerobot_wm.data.check_files import (
    check_contents,
    check_frames,
    check_tasks,
    check_video_file,
    check_video_times,
    read_episodes,
)
from lerobot_wm.data.check_meta import check_stats, read_info
from lerobot_wm.data.source import DatasetError, dataset_folder, is_snapshot


def check_dataset(repo_id: str, root: str | Path | None = None, revision: str | None = None) -> None:
    """Refuse a dataset on this machine that is not whole, or whose parts do not belong together.

    Nothing is looked up elsewhere. A dataset that is not here passes: LeRobot will download it.

    Args:
        repo_id: The dataset's name.
        root: Its folder; None looks where LeRobot does.
        revision: As in `LeRobotDataset`.

    Raises:
        DatasetError: Names the file, what is wrong with it, and how to mend it.
        HFValidationError: The name is none of a repository and no folder is given.
    """
    if root is None:
        validate_repo_id(repo_id)
    folder = dataset_folder(repo_id, root, revision)
    if folder is not None:
        with _removal_named(folder):
            _check_folder(folder)


def _check_folder(folder: Path) -> None:
    info = read_info(folder)
    check_stats(info)
    check_tasks(info)
    episodes = read_episodes(info)
    # Of a dataset of the Hub some episodes may be here; LeRobot downloads the others when they are asked for.
    partial = is_snapshot(folder) or (folder / ".cache" / "huggingface").is_dir()
    check_frames(info, episodes, partial)
    for camera in info.video_keys:
        check_video_times(info, camera, episodes)
        for path, seconds in info.videos(camera, episodes).items():
            if path.exists() or not partial:
                check_video_file(info, camera, path, seconds)


@contextmanager
def damage_named(repo_id: str, root: str | Path | None, revision: str | None) -> Iterator[None]:
    """Name the file where LeRobot finds a table damaged that `check_dataset` passed: it reads no values.

    Raises:
        DatasetError: Names the file.
    """
    try:
        yield
    except DatasetGenerationError:
        folder = dataset_folder(repo_id, root, revision)
        if folder is not None:
            with _removal_named(folder):
                check_contents(folder)
        raise


@contextmanager
def _removal_named(folder: Path) -> Iterator[None]:
    """Say how to have a dataset of the Hub downloaded again: what is in its cache LeRobot takes from there."""
    try:
        yield
    except DatasetError as error:
        if not is_snapshot(folder):
            raise
        raise DatasetError(
            f"{error} What is in the Hub's cache is not downloaded again: remove {folder.parents[1]} first."
        ) from error
