"""A file of records that is yet to be written."""

from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

from lerobot_wm.data.lock import sole_writer


@contextmanager
def new_records(path: Path) -> Iterator[None]:
    """Hold a records file while its rollouts run; earlier records are never written over.

    Raises:
        FileExistsError: It is there already.
        BlockingIOError: Another process writes it.
    """
    with sole_writer(path):
        if path.exists():
            raise FileExistsError(
                f"{path} holds the records of an earlier evaluation: remove it, or give another --output_dir, or "
                "--records of lerobot-wm eval."
            )
        yield
