"""Updates a second of policies on latents: one in each step of LeRobot's loop against several.

    python -m benchmarks.updates --output=updates.json

Both by turns, the whole command, one thread, in the precision that the machine is fast in. Networks of the usual width,
on 256 samples, and tiny ones, on 8: these compute next to nothing, and tell what an update costs beside its arithmetic.
Prints one JSON document: `provenance` and `rows` in the form of results/benchmarks.
"""

import argparse
import json
import os
import shlex
import statistics
import sys
import tempfile
from pathlib import Path
from typing import Any

from benchmarks.measure import THREAD_VARIABLES
from benchmarks.sides.training import in_one_step
from lerobot_wm.records import provenance

UPDATES = 20  # in a step
SIZES = ((256, 256), (8, 8))  # samples of an update, width of the networks
SECONDS, REPEATS = 15.0, 3


def measure(folder: Path) -> list[dict[str, Any]]:
    """Every row; the data is made in `folder`."""
    rows = []
    for policy in ("wm_bc", "wm_iql"):
        for batch, width in SIZES:
            speeds: dict[int, list[float]] = {1: [], UPDATES: []}  # updates/s
            for _ in range(REPEATS):
                for updates, found in speeds.items():
                    side = in_one_step(folder, policy, updates, batch, width, SECONDS)
                    found.append(updates * side.measure())
            one, several = (statistics.median(found) for found in speeds.values())
            rows.append(
                {
                    "row": f"{policy}, {UPDATES} updates in a step",
                    "ours": several,
                    "peer": one,
                    "peer_name": "one update in a step",
                    "ratio": several / one,
                    "unit": "updates/s",
                    "sizes": {"batch": batch, "width": width, "threads": 1},
                    "repeats": {str(updates): sorted(map(round, found)) for updates, found in speeds.items()},
                }
            )
    return rows


def main() -> None:
    """Measure, print, write."""
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("--output", type=Path, help="write the JSON here, too")
    args = parser.parse_args()
    os.environ.update(dict.fromkeys(THREAD_VARIABLES, "1"))
    with tempfile.TemporaryDirectory() as folder:
        rows = measure(Path(folder))
    source = {**provenance(), "command": f"python -m benchmarks.updates {shlex.join(sys.argv[1:])}"}
    text = json.dumps({"provenance": source, "rows": rows}, indent=2)
    print(text)
    if args.output is not None:
        args.output.write_text(text + "\n")


if __name__ == "__main__":
    main()
