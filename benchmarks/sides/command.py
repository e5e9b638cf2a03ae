"""A whole command by the clock."""

import subprocess
import sys
import tempfile
import time
from pathlib import Path

from benchmarks.timing import Prepared


def per_minute(command: list[str], output_flag: str, folder: Path, units: int) -> Prepared:
    """Units of work per minute of a `python -m` command, its start-up included.

    Args:
        command: The module and its flags.
        output_flag: The flag that names the folder it writes to, a new one each time.
        folder: Where these are made.
        units: How many units the command does.
    """

    def measure() -> float:
        output = Path(tempfile.mkdtemp(dir=folder)) / "output"
        start = time.perf_counter()
        subprocess.run([sys.executable, "-m", *command, f"{output_flag}={output}"], check=True)
        return units * 60 / (time.perf_counter() - start)

    return Prepared(measure)
