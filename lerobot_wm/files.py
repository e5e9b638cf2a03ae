"""Files that are whole or not there."""

import errno
import fcntl
import logging
import os
from collections.abc import Iterator
from contextlib import ExitStack, contextmanager, suppress
from pathlib import Path
from typing import IO


def write_whole(path: Path, text: str) -> None:
    """Write a file, its folder too, or replace it at once: a process that is killed leaves the one before."""
    path.parent.mkdir(parents=True, exist_ok=True)
    unfinished = path.with_name(f"{path.name}.part")
    unfinished.write_text(text)
    unfinished.replace(path)


logger = logging.getLogger(__name__)

_NO_LOCKS = (errno.ENOLCK, errno.ENOSYS, errno.ENOTSUP)  # some network file systems have none


@contextmanager
def sole_writer(output: Path, job: str | None = None, *, wait: bool = False) -> Iterator[None]:
    """Hold an output, whose folder is made, while it is written; the lock ends with the process, however that ends.

    The lock is a hidden file beside the output, which the last to hold it removes.

    Args:
        output: A file or folder, there or not.
        job: Which of several jobs that share the work; different ones get along.
        wait: Wait for another writer to end, instead of refusing.

    Raises:
        BlockingIOError: Another process writes it.
        OSError: The folder cannot be written.
    """
    output = Path(os.path.abspath(output))  # of `.` the name, and what is beside it
    output.parent.mkdir(parents=True, exist_ok=True)
    # Jobs share the lock of the whole, for which filelock has no kind; each holds its own alone.
    locks = {f".{output.name}.lock": fcntl.LOCK_EX if job is None else fcntl.LOCK_SH}
    if job is not None:
        locks[f".{output.name}.{job}.lock"] = fcntl.LOCK_EX
    with ExitStack() as stack:
        for name, kind in locks.items():
            try:
                stack.enter_context(_locked(output.with_name(name), kind if wait else kind | fcntl.LOCK_NB))
            except BlockingIOError as error:
                raise BlockingIOError(
                    f"another process is writing {output}: wait until it has ended, end it, or choose another output."
                ) from error
        yield


@contextmanager
def _locked(path: Path, operation: int) -> Iterator[None]:
    file = _lock(path, operation)
    try:
        yield
    finally:
        with file, suppress(OSError):  # others hold it still
            fcntl.flock(file, fcntl.LOCK_EX | fcntl.LOCK_NB)
            path.unlink()


def _lock(path: Path, operation: int) -> IO:
    """The lock's file, open and locked."""
    while True:
        file = path.open("a")
        try:
            fcntl.flock(file, operation)
        except OSError as error:
            if error.errno not in _NO_LOCKS:
                file.close()
                raise
            logger.warning("%s: this file system has no locks; see that nothing else writes there.", path)
            return file
        with suppress(FileNotFoundError):  # its last holder may have removed it just before
            if os.path.samestat(os.fstat(file.fileno()), path.stat()):
                return file
        file.close()
