"""`python -m benchmarks`: measure rows side by side with their peers, print a table, write JSON."""

import argparse
import json
import shlex
import sys
import tempfile
from dataclasses import asdict, replace
from pathlib import Path
from typing import Any

from rich.console import Console

from benchmarks.environments import ROOT
from benchmarks.measure import Result, measure_row
from benchmarks.rows import ROWS, Row
from benchmarks.table import WIDTH, markdown_table, results_table, rows_table, size_text
from lerobot_wm.files import write_whole
from lerobot_wm.records import provenance
from lerobot_wm.system import cpu_kind, usable_cores

SCALES = {"small": 0.1, "normal": 1.0, "large": 10.0}


def parse_scale(text: str) -> float:
    """Return the factor of `--scale`, a name or a number."""
    return SCALES[text] if text in SCALES else float(text)


def parse_rows(text: str) -> list[Row]:
    """Return the rows of `--rows`, in the order of the table.

    Raises:
        argparse.ArgumentTypeError: A row does not exist.
    """
    names = [name.strip() for name in text.split(",")]
    unknown = sorted(set(names) - {row.name for row in ROWS})
    if unknown:
        raise argparse.ArgumentTypeError(
            f"unknown row {', '.join(unknown)}; expected some of {', '.join(row.name for row in ROWS)}."
        )
    return [row for row in ROWS if row.name in names]


def parse_arguments(arguments: list[str]) -> argparse.Namespace:
    """Parse the flags; exit with a message if one is wrong."""
    parser = argparse.ArgumentParser(prog="python -m benchmarks", description=__doc__)
    parser.add_argument(
        "--list", action="store_true", help="show rows, sizes and needed environments, then exit"
    )
    parser.add_argument("--rows", type=parse_rows, default=list(ROWS), help="row names, separated by commas")
    parser.add_argument("--scale", type=parse_scale, default=1.0, help="small, normal, large or a factor")
    parser.add_argument("--threads", type=int, default=1, help="threads of each side's process")
    parser.add_argument("--repeats", type=int, default=3, help="measurements of each side, taken in turns")
    default = ROOT / "outputs" / "benchmarks" / f"cpu{usable_cores()}.json"
    parser.add_argument("--output", type=Path, default=default, help="JSON file; other rows in it are kept")
    return parser.parse_args(arguments)


def check_machine(path: Path) -> None:
    """Refuse to mix measurements of two processors in one file.

    Raises:
        SystemExit: The file holds measurements of another processor.
    """
    entries = json.loads(path.read_text()) if path.is_file() else []
    others = {entry["provenance"].get("CPU", "unknown") for entry in entries} - {cpu_kind()}
    if others:
        sys.exit(
            f"{path} was measured on another processor ({', '.join(others)}); this is {cpu_kind()}. "
            "Choose another --output."
        )


def write(results: list[Result], path: Path) -> None:
    """Add results to the JSON file, replacing those of the same row, size and peer, and rewrite its Markdown table."""

    def key(entry: dict[str, Any]) -> tuple[str, str, str | None]:
        return entry["row"], json.dumps(entry["sizes"], sort_keys=True), entry["peer_name"]

    old = json.loads(path.read_text()) if path.is_file() else []
    kept = {key(entry): entry for entry in [*old, *map(asdict, results)]}
    write_whole(path, json.dumps(list(kept.values()), indent=1) + "\n")
    path.with_suffix(".md").write_text(markdown_table(kept.values()))


def main(arguments: list[str]) -> int:
    """Measure, print and write; return how many rows and sizes failed."""
    flags = parse_arguments(arguments)
    console = Console(width=WIDTH)
    if flags.list:
        console.print(rows_table(flags.rows, flags.scale))
        return 0
    check_machine(flags.output)
    source = {**provenance(), "command": f"python -m benchmarks {shlex.join(arguments)}"}
    results: list[Result] = []
    failures = 0
    with tempfile.TemporaryDirectory(prefix="benchmarks-") as folder:
        for row in flags.rows:
            for size in row.scaled_sizes(flags.scale):
                console.print(f"{row.name}: {size_text(size)}")
                try:
                    measured = measure_row(row, size, Path(folder), flags.threads, flags.repeats)
                except RuntimeError as error:
                    console.print(f"{row.name} failed. {error}", style="red", markup=False)
                    failures += 1
                    continue
                results += [replace(result, provenance=source) for result in measured]
                write(results, flags.output)  # now, so that an interrupted run keeps what it has measured
    console.print(results_table(results))
    console.print(f"Written: {flags.output}")
    return failures


if __name__ == "__main__":
    sys.exit(main(sys.argv[1:]))
