"""Time whole commands."""

import subprocess
import sys
import tempfile
import time
from pathlib import Path

from benchmarks.timing import Prepared


def per_minute(command: list[str], output_flag: str, folder: Path, units: int) -> Prepared:
    """Measure units of work per minute of a `python -m` command, start-up included.

    Args:
        command: The module and its flags.
        output_flag: The flag for the output folder, which is new each time.
        folder: Parent of the output folders.
        units: Units of work that the command does.
    """

    def measure() -> float:
        output = Path(tempfile.mkdtemp(dir=folder)) / "output"
        start = time.perf_counter()
        subprocess.run([sys.executable, "-m", *command, f"{output_flag}={output}"], check=True)
        return units * 60 / (time.perf_counter() - start)

    return Prepared(measure)
