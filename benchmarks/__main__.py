"""`python -m benchmarks`: every row side by side with its peers, as a table and as JSON."""

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
    """The factor that `--scale` names.

    Raises:
        argparse.ArgumentTypeError: It is neither a name nor a positive number.
    """
    try:
        scale = SCALES[text] if text in SCALES else float(text)
    except ValueError:
        scale = 0.0
    if scale <= 0:
        raise argparse.ArgumentTypeError(f"'{text}': expected {', '.join(SCALES)} or a positive factor.")
    return scale


def parse_rows(text: str) -> list[Row]:
    """The rows that `--rows` names, in the order of the table.

    Raises:
        argparse.ArgumentTypeError: There is no row of a name.
    """
    names = [name.strip() for name in text.split(",")]
    unknown = sorted(set(names) - {row.name for row in ROWS})
    if unknown:
        raise argparse.ArgumentTypeError(
            f"no row {', '.join(unknown)}; there are {', '.join(row.name for row in ROWS)}."
        )
    return [row for row in ROWS if row.name in names]


def positive(text: str) -> int:
    """A whole number of at least 1.

    Raises:
        ValueError: It is none.
    """
    value = int(text)
    if value < 1:
        raise ValueError
    return value


def parse_arguments(arguments: list[str]) -> argparse.Namespace:
    """The flags; ends with a message where one is wrong."""
    parser = argparse.ArgumentParser(prog="python -m benchmarks", description=__doc__)
    parser.add_argument("--list", action="store_true", help="show rows, sizes and what they need, and stop")
    parser.add_argument("--rows", type=parse_rows, default=list(ROWS), help="names separated by commas")
    parser.add_argument("--scale", type=parse_scale, default=1.0, help="small, normal, large or a factor")
    parser.add_argument("--threads", type=positive, default=1, help="of each side's process")
    parser.add_argument("--repeats", type=positive, default=3, help="of each side, by turns")
    default = ROOT / "outputs" / "benchmarks" / f"cpu{usable_cores()}.json"
    parser.add_argument("--output", type=Path, default=default, help="JSON file; rows that are in it stay")
    return parser.parse_args(arguments)


def check_machine(path: Path) -> None:
    """Refuse to put measurements beside those of another processor.

    Raises:
        SystemExit: The file holds some; names both processors.
    """
    entries = json.loads(path.read_text()) if path.is_file() else []
    others = {entry["provenance"].get("CPU", "one that was not noted") for entry in entries} - {cpu_kind()}
    if others:
        sys.exit(
            f"{path} was measured on another processor ({', '.join(others)}; here it is {cpu_kind()}): "
            "give another --output."
        )


def write(results: list[Result], path: Path) -> None:
    """Put results into the file, in place of earlier ones of the same row, size and peer; and its table beside it."""

    def key(entry: dict[str, Any]) -> tuple[str, str, str | None]:
        return entry["row"], json.dumps(entry["sizes"], sort_keys=True), entry["peer_name"]

    old = json.loads(path.read_text()) if path.is_file() else []
    kept = {key(entry): entry for entry in [*old, *map(asdict, results)]}
    write_whole(path, json.dumps(list(kept.values()), indent=1) + "\n")
    path.with_suffix(".md").write_text(markdown_table(kept.values()))


def main(arguments: list[str]) -> int:
    """Measure, print and write; returns the number of rows and sizes that failed."""
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
                write(results, flags.output)  # a run that is interrupted leaves what it has measured
    console.print(results_table(results))
    console.print(f"Written: {flags.output}")
    return failures


if __name__ == "__main__":
    sys.exit(main(sys.argv[1:]))
