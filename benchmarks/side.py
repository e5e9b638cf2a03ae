"""Run one side of a row: `python -m benchmarks.side MODULE:FUNCTION SIZE_AS_JSON FOLDER`.

Calls `FUNCTION(folder, **size)` and prints its facts as one line of JSON. Then it measures once for every line that it
reads, and prints the value. Output of libraries goes to standard error.
"""

import importlib
import json
import os
import sys
from pathlib import Path


def main() -> None:
    """Prepare the side, then measure on request until standard input is closed."""
    target, size, folder = sys.argv[1:]
    answers = os.fdopen(os.dup(sys.stdout.fileno()), "w", buffering=1)
    os.dup2(sys.stderr.fileno(), sys.stdout.fileno())
    module, function = target.split(":")
    prepare = getattr(importlib.import_module(module), function)
    prepared = prepare(Path(folder), **json.loads(size))
    print(json.dumps(prepared.facts), file=answers)
    for _ in sys.stdin:
        print(json.dumps(prepared.measure()), file=answers)


if __name__ == "__main__":  # worker processes import this module again
    main()
