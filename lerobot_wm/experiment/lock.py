"""One run at a time in a folder."""

import fcntl
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import IO


@contextmanager
def exclusive(output_dir: Path) -> Iterator[IO]:
    """Hold a folder's lock, which its running stages hold too.

    Raises:
        BlockingIOError: another run, or a stage that a killed run left behind, is at work there.
    """
    output_dir.mkdir(parents=True, exist_ok=True)
    with (output_dir / ".lock").open("w") as lock:
        try:
            fcntl.flock(lock, fcntl.LOCK_EX | fcntl.LOCK_NB)
        except BlockingIOError as error:
            raise BlockingIOError(
                f"Another run, or a stage that a killed run left behind, is at work in {output_dir}: wait until it "
                "has ended, end it, or give another --output_dir."
            ) from error
        yield lock
