"""Outputs that are complete or absent, and that one process at a time writes."""

import errno
import fcntl
import logging
import os
import shutil
import tempfile
from collections.abc import Callable, Iterator
from contextlib import ExitStack, contextmanager, suppress
from pathlib import Path
from typing import IO

from tqdm import tqdm

logger = logging.getLogger(__name__)

UNFINISHED = ".part"  # suffix of an output that is still being written
# Some network file systems have no locks.
_NO_LOCKS = (errno.ENOLCK, errno.ENOSYS, errno.ENOTSUP)


@contextmanager
def appears_whole(path: Path) -> Iterator[Path]:
    """Write a file or folder under a temporary name beside it, and rename it when the block ends without an error.

    What a killed process left under the temporary name is removed first, what this one leaves on an error afterwards.

    Yields:
        The temporary path, where nothing exists yet; its parent folder does.
    """
    path.parent.mkdir(parents=True, exist_ok=True)
    temporary = path.with_name(f"{path.name}{UNFINISHED}")
    _remove(temporary)
    try:
        yield temporary
        temporary.replace(path)
    except BaseException:
        # Whatever cannot be removed, the error matters more.
        with suppress(OSError):
            _remove(temporary)
        raise


def _remove(path: Path) -> None:
    if path.is_dir():
        shutil.rmtree(path)
    else:
        path.unlink(missing_ok=True)


def write_whole(path: Path, text: str) -> None:
    """Write a text file, or replace it at once; its folder is created."""
    with appears_whole(path) as temporary:
        temporary.write_text(text)


def check_writable(folder: Path) -> None:
    """Check that files can be written into a folder, or into the place where it would be made.

    Raises:
        OSError: They cannot; names the folder that exists.
    """
    existing = next(path for path in (folder.absolute(), *folder.absolute().parents) if path.exists())
    try:
        with tempfile.TemporaryFile(dir=existing):
            pass
    except OSError as error:
        error.filename = str(existing)
        raise


@contextmanager
def sole_writer(output: Path, job: str | None = None, *, wait: bool = False) -> Iterator[IO]:
    """Hold a lock on an output while it is written; the lock ends with the process, however that ends.

    The lock is a hidden file beside the output. Its last holder removes it.

    Args:
        output: A file or folder, which need not exist; its parent folder is created.
        job: One of several jobs that share the work: different jobs may write at the same time.
        wait: Wait for another writer instead of raising an error.

    Yields:
        The output's lock file. A subprocess that inherits it holds the lock too, even if this process is killed.

    Raises:
        BlockingIOError: Another process is writing the output.
        OSError: The folder is not writable.
    """
    # An absolute path, because `.` has neither a name nor a place beside it.
    output = Path(os.path.abspath(output))
    output.parent.mkdir(parents=True, exist_ok=True)
    # Jobs share the lock of the whole output, and each holds one of its own.
    locks = {f".{output.name}.lock": fcntl.LOCK_EX if job is None else fcntl.LOCK_SH}
    if job is not None:
        locks[f".{output.name}.{job}.lock"] = fcntl.LOCK_EX
    with ExitStack() as stack:
        files = []
        for name, kind in locks.items():
            operation = kind if wait else kind | fcntl.LOCK_NB
            try:
                files.append(stack.enter_context(_locked(output.with_name(name), operation)))
            except BlockingIOError as error:
                raise BlockingIOError(
                    f"another process is writing {output}: wait for it, stop it, or choose another output."
                ) from error
        yield files[0]


@contextmanager
def _locked(path: Path, operation: int) -> Iterator[IO]:
    file = _lock(path, operation)
    try:
        yield file
    finally:
        # Only the last holder gets the exclusive lock, and removes the file.
        with file, suppress(OSError):
            fcntl.flock(file, fcntl.LOCK_EX | fcntl.LOCK_NB)
            path.unlink()


def _lock(path: Path, operation: int) -> IO:
    """Open and lock a lock file."""
    while True:
        file = path.open("a")
        try:
            fcntl.flock(file, operation)
        except OSError as error:
            if error.errno not in _NO_LOCKS:
                file.close()
                raise
            logger.warning(
                "%s: no locks on this file system; make sure that no other process writes there.", path
            )
            return file
        # The last holder may have removed the file between our opening and locking it.
        with suppress(FileNotFoundError):
            if os.path.samestat(os.fstat(file.fileno()), path.stat()):
                return file
        file.close()


@contextmanager
def new_folder(path: Path) -> Iterator[Path]:
    """Write a folder that must not exist yet, and appears when it is complete.

    Yields:
        The folder to write into.

    Raises:
        FileExistsError: It exists already.
        BlockingIOError: Another process is writing it.
    """
    with sole_writer(path):
        if path.exists():
            raise FileExistsError(f"{path} already exists: choose another output folder, or remove it.")
        with appears_whole(path) as temporary:
            yield temporary


def copy_dataset(root: Path, folder: Path, new_name: Callable[[str], str] = str) -> None:
    """Copy the files of a LeRobotDataset, with a progress bar.

    Args:
        root: The dataset's folder.
        folder: Folder of the copy.
        new_name: Gives a file's path in the copy, from its path in the dataset.
    """
    parts = ("meta", "data", "videos")
    files = [path for part in parts for path in (root / part).rglob("*") if path.is_file()]
    for path in tqdm(files, desc="Copying", unit="file"):
        copy = folder / new_name(path.relative_to(root).as_posix())
        copy.parent.mkdir(parents=True, exist_ok=True)
        shutil.copy2(path, copy)
