"""What is wrong with a dataset, in one line."""

from pathlib import Path

from huggingface_hub import snapshot_download
from huggingface_hub.errors import LocalEntryNotFoundError
from lerobot.datasets.dataset_metadata import CODEBASE_VERSION
from lerobot.datasets.utils import has_legacy_hub_download_metadata, is_valid_version
from lerobot.utils.constants import HF_LEROBOT_HOME, HF_LEROBOT_HUB_CACHE
from packaging.version import Version


class DatasetError(ValueError):
    """A dataset that cannot be used; its text is one line: the file, what is wrong with it, and how to mend it."""


def dataset_folder(
    repo_id: str, root: str | Path | None = None, revision: str | None = None, *, whole: bool = False
) -> Path | None:
    """The folder that LeRobot reads a dataset from; the network is not asked.

    That is `root`; without it what was recorded under the dataset's name, whatever the revision; and else the snapshot
    of that revision in LeRobot's cache of the Hub, as the last download left it.

    Args:
        repo_id: The dataset's name.
        root: As in `LeRobotDataset`.
        revision: As in `LeRobotDataset`.
        whole: Of a snapshot, whether all of it must be here; otherwise its metadata will do, and LeRobot downloads the
            other files when they are asked for.

    Returns:
        The folder; None where LeRobot will download the dataset first.
    """
    if root is not None:
        return Path(root) if _is_dataset(Path(root)) else None
    recorded = HF_LEROBOT_HOME / repo_id
    # LeRobot passes over what its older releases downloaded there.
    if _is_dataset(recorded) and not has_legacy_hub_download_metadata(recorded):
        return recorded
    revision = revision or CODEBASE_VERSION
    try:
        snapshot = snapshot_download(
            repo_id,
            repo_type="dataset",
            revision=f"v{Version(revision)}" if is_valid_version(revision) else revision,
            cache_dir=HF_LEROBOT_HUB_CACHE,
            allow_patterns=None if whole else "meta/",
            local_files_only=True,
        )
    except LocalEntryNotFoundError:
        return None
    return Path(snapshot)


def is_snapshot(folder: Path) -> bool:
    """Whether a dataset's folder is one of a cache of the Hub, `.../datasets--OWNER--NAME/snapshots/COMMIT`."""
    return folder.parent.name == "snapshots" and folder.parents[1].name.startswith("datasets--")


def _is_dataset(folder: Path) -> bool:
    """Whether any part of a dataset is there."""
    return any((folder / part).exists() for part in ("meta", "data", "videos"))
