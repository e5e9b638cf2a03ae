"""The gate for datasets: where a LeRobotDataset is on this machine, and opening it once it is checked."""

from collections.abc import Collection, Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path

from datasets.exceptions import DatasetGenerationError
from huggingface_hub import snapshot_download
from huggingface_hub.errors import LocalEntryNotFoundError
from huggingface_hub.utils import validate_repo_id
from lerobot.datasets.dataset_metadata import CODEBASE_VERSION, LeRobotDatasetMetadata
from lerobot.datasets.lerobot_dataset import LeRobotDataset
from lerobot.datasets.utils import get_repo_versions, has_legacy_hub_download_metadata, is_valid_version
from lerobot.utils.constants import HF_LEROBOT_HOME, HF_LEROBOT_HUB_CACHE
from packaging.version import Version

from lerobot_wm.data.check import (
    DatasetError,
    check_dataset,
    check_metadata_files,
    how_to_repair,
    name_damaged_metadata,
    name_damaged_table,
    strange_entries_named,
)
from lerobot_wm.data.tables import check_finite_dataset, check_stats
from lerobot_wm.errors import HubRefusalError


@dataclass
class SourceConfig:
    """`--dataset.repo_id`, `--dataset.root` and `--dataset.revision`, as in `lerobot-train`."""

    repo_id: str
    root: str | None = None
    revision: str | None = None

    def metadata(self, episodes: Collection[int] | None = None) -> LeRobotDatasetMetadata:
        """The dataset's metadata, of which some episodes will be read; raises what `open_dataset` does."""
        return open_dataset(self.repo_id, self.root, self.revision, episodes)

    def open(self) -> LeRobotDataset:
        """The dataset with all of its episodes; downloaded if it is not on this machine.

        Raises:
            DatasetError: See `open_dataset`; also if an observation, action or reward is not finite.
            HubRefusalError: See `open_dataset`.
        """
        open_dataset(self.repo_id, self.root, self.revision)
        with damaged_tables_named(self.repo_id, self.root, self.revision):
            dataset = LeRobotDataset(self.repo_id, root=self.root, revision=self.revision)
        check_finite_dataset(dataset)
        return dataset


def open_dataset(
    repo_id: str,
    root: str | Path | None = None,
    revision: str | None = None,
    episodes: Collection[int] | None = None,
) -> LeRobotDatasetMetadata:
    """Check a dataset and return its metadata; metadata that is not on this machine is downloaded.

    Files on this machine are checked without the network; files that LeRobot will download are not.

    Args:
        repo_id: The dataset's name.
        root: As in `LeRobotDataset`.
        revision: As in `LeRobotDataset`.
        episodes: The episodes that will be read; None for all.

    Raises:
        DatasetError: Files are missing or damaged, do not belong together, or have another version than 3.
        HubRefusalError: The dataset on the Hub has no such version.
        HFValidationError: No folder is given and the name is not a valid repository name.
    """
    if root is None:
        validate_repo_id(repo_id)
    folder = dataset_folder(repo_id, root, revision)
    with _cache_named(folder):
        if folder is not None:
            check_metadata_files(folder, repo_id)
        # LeRobot asks the Hub for the version of a snapshot too.
        if folder is None or (root is None and is_snapshot(folder)):
            _check_version_on_hub(repo_id, revision)
        try:
            meta = LeRobotDatasetMetadata(repo_id, root=root, revision=revision)
        except Exception:
            if folder is not None:
                name_damaged_metadata(folder)
            raise
        is_download = is_snapshot(meta.root) or (meta.root / ".cache" / "huggingface").is_dir()
        with strange_entries_named(meta.root):
            check_dataset(meta, partial=is_download, chosen=episodes)
            check_stats(meta)
    return meta


@contextmanager
def damaged_tables_named(repo_id: str, root: str | Path | None, revision: str | None) -> Iterator[None]:
    """Name the file when LeRobot finds damage in columns of numbers that `open_dataset` does not read.

    Raises:
        DatasetError: Names the file.
    """
    try:
        yield
    except DatasetGenerationError:
        folder = dataset_folder(repo_id, root, revision)
        if folder is not None:
            with _cache_named(folder):
                name_damaged_table(folder)
        raise


@contextmanager
def _cache_named(folder: Path | None) -> Iterator[None]:
    """Add to errors about a snapshot what must be removed before LeRobot downloads it again."""
    try:
        yield
    except DatasetError as error:
        if folder is None or not is_snapshot(folder):
            raise
        raise DatasetError(
            f"{error} Files in the Hub's cache are not downloaded again: first remove {folder.parents[1]}."
        ) from error


def _check_version_on_hub(repo_id: str, revision: str | None) -> None:
    """Check that a version is on the Hub, which LeRobot would say in twenty lines; branches and commits pass."""
    if not is_valid_version(revision or CODEBASE_VERSION):
        return
    versions = sorted(get_repo_versions(repo_id))
    if not versions:
        raise HubRefusalError(
            f"dataset {repo_id} has no version tag such as {CODEBASE_VERSION}: its upload did not finish, or it is not "
            "a LeRobot dataset. Push it again, or give --dataset.revision=main to read what is there."
        )
    if versions[-1] < Version("3"):
        name, version = repo_id.split("/")[-1], f"v{versions[-1]}"
        raise HubRefusalError(
            f"dataset {repo_id} is of version {version}; expected {CODEBASE_VERSION}. Download it with "
            f"`hf download {repo_id} --repo-type=dataset --revision={version} --local-dir=data/{name}`; then "
            f"{how_to_repair(repo_id, Path('data') / name)}."
        )
    if revision is not None and Version(revision) not in versions:
        raise HubRefusalError(
            f"dataset {repo_id} has no revision {revision!r}; it has the versions "
            f"{', '.join(f'v{version}' for version in versions)}: give one of them as --dataset.revision."
        )


def dataset_folder(
    repo_id: str, root: str | Path | None = None, revision: str | None = None, *, whole: bool = False
) -> Path | None:
    """The folder that LeRobot reads a dataset from, without asking the network.

    That is `root`; without it a dataset recorded under this name, whatever the revision; else the snapshot of that
    revision in LeRobot's cache of the Hub, as the last download left it.

    Args:
        repo_id: The dataset's name.
        root: As in `LeRobotDataset`.
        revision: As in `LeRobotDataset`.
        whole: Whether all files of a snapshot must be here; otherwise its metadata is enough, and LeRobot downloads
            other files when they are needed.

    Returns:
        The folder; None if LeRobot would download the dataset first.
    """
    if root is not None:
        return Path(root) if _is_dataset(Path(root)) else None
    recorded = HF_LEROBOT_HOME / repo_id
    # LeRobot ignores what its older releases downloaded there.
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
    """Whether a folder is in a cache of the Hub: `.../datasets--OWNER--NAME/snapshots/COMMIT`."""
    return folder.parent.name == "snapshots" and folder.parents[1].name.startswith("datasets--")


def _is_dataset(folder: Path) -> bool:
    return any((folder / name).exists() for name in ("meta", "data", "videos"))
