"""Measure sides in turns, each in its own process, and summarise and write the values."""

import json
import math
import os
import shlex
import statistics
import subprocess
import sys
from collections.abc import Collection, Sequence
from contextlib import ExitStack, suppress
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

from benchmarks.environments import ROOT, python_of
from benchmarks.rows import Row, Side, Size
from lerobot_wm.records import provenance

LOSS_TOLERANCE = 1e-4  # relative; allows for another order of additions
# With fresh weights the losses of two architectures hardly differ; the gradient norm does.
LOSSES = ("loss", "image_loss", "reward_loss", "kl", "gradient_norm")
THREAD_VARIABLES = ("OMP_NUM_THREADS", "MKL_NUM_THREADS", "OPENBLAS_NUM_THREADS", "LP_NUM_THREADS")


class SideError(RuntimeError):
    """A side ended before it answered, or two sides compute different losses."""


@dataclass(frozen=True)
class Spread:
    """Median and range of a side's values in the row's unit."""

    median: float
    low: float
    high: float

    @classmethod
    def of(cls, values: Sequence[float]) -> "Spread":
        """Summarise at least one value."""
        return cls(statistics.median(values), min(values), max(values))


@dataclass(frozen=True)
class Result:
    """A row at one size against one peer, as it is stored in results/benchmarks.

    Attributes:
        row: The row's name.
        ours: Our median.
        peer: The peer's median; None for a row without a peer.
        peer_name: The peer's name.
        ratio: How many times faster ours is.
        unit: Unit of `ours` and `peer`.
        sizes: Parameters of the row and the number of threads.
        repeats: Number of values of each side.
        spread: The lowest and highest value of each side.
        facts: What each side reports about itself, such as its losses.
        provenance: The command, versions and machine.
    """

    row: str
    ours: float
    peer: float | None
    peer_name: str | None
    ratio: float | None
    unit: str
    sizes: dict[str, float]
    repeats: int
    spread: dict[str, list[float]]
    facts: dict[str, dict[str, Any]] = field(default_factory=dict)
    provenance: dict[str, str] = field(default_factory=dict)


def speed_up(ours: float, peer: float, less_is_better: bool) -> float:
    """Return how many times faster ours is; both values have the same unit."""
    return peer / ours if less_is_better else ours / peer


class SideProcess:
    """A process that runs `benchmarks.side`, prepared and ready to measure."""

    def __init__(self, side: Side, row: Row, size: Size, folder: Path, threads: int) -> None:
        self._side = side
        self._log = folder / f"{side.function.replace(':', '.')}.log"
        command = [str(python_of(side.environment)), "-m", "benchmarks.side", side.function]
        variables = {
            **os.environ,
            **dict.fromkeys(THREAD_VARIABLES, str(threads)),
            "MUJOCO_GL": os.environ.get("MUJOCO_GL", "egl"),
            "HF_HUB_OFFLINE": "1",
            **row.variables,
        }
        with self._log.open("w") as log:
            self._process = subprocess.Popen(
                [*command, json.dumps(size), str(folder)],
                cwd=ROOT,
                env=variables,
                stdin=subprocess.PIPE,
                stdout=subprocess.PIPE,
                stderr=log,
                text=True,
            )
        self.facts: dict[str, Any] = self._answer()

    def __enter__(self) -> "SideProcess":
        return self

    def __exit__(self, *exception: object) -> None:
        self._process.communicate()  # closes its standard input, which ends the process

    def measure(self) -> float:
        """Measure once."""
        assert self._process.stdin is not None
        with suppress(BrokenPipeError):  # it has ended; reading the answer then fails
            self._process.stdin.write("measure\n")
            self._process.stdin.flush()
        return self._answer()

    def _answer(self) -> Any:
        assert self._process.stdout is not None
        line = self._process.stdout.readline()
        if not line:
            end = "\n".join(self._log.read_text().splitlines()[-20:])
            raise SideError(f"{self._side.name} ({self._side.function}) ended without an answer:\n{end}")
        return json.loads(line)


def measure_row(row: Row, size: Size, folder: Path, threads: int, repeats: int) -> list[Result]:
    """Measure a row at one size; return a result for each peer, or one if there is no peer.

    Args:
        row: What to measure.
        size: One of its sizes, scaled.
        folder: Folder for the data of the sides, shared by all rows.
        threads: Threads of each side's process.
        repeats: How often each side is measured; the sides take turns.

    Raises:
        SideError: A side failed, or the sides compute different losses.
    """
    sides = (row.ours, *row.peers)
    with ExitStack() as running:
        # Ours starts first because peers read its data and weights.
        processes = [running.enter_context(SideProcess(side, row, size, folder, threads)) for side in sides]
        facts = {side.name: process.facts for side, process in zip(sides, processes, strict=True)}
        check_losses(facts)
        values: list[list[float]] = [[] for _ in sides]
        for _ in range(repeats):
            for process, of_side in zip(processes, values, strict=True):
                of_side.append(process.measure())
    ours, *peers = (Spread.of(of_side) for of_side in values)
    sizes = {**size, "threads": threads}

    def result(peer: Spread | None, name: str | None) -> Result:
        spreads = {"ours": ours} if peer is None else {"ours": ours, "peer": peer}
        return Result(
            row=row.name,
            ours=ours.median,
            peer=None if peer is None else peer.median,
            peer_name=name,
            ratio=None if peer is None else speed_up(ours.median, peer.median, row.less_is_better),
            unit=row.unit,
            sizes=sizes,
            repeats=repeats,
            spread={who: [spread.low, spread.high] for who, spread in spreads.items()},
            facts={who: fact for who, fact in facts.items() if fact and who in (row.ours.name, name)},
        )

    if not peers:
        return [result(None, None)]
    return [result(peer, side.name) for peer, side in zip(peers, row.peers, strict=True)]


def check_losses(facts: dict[str, dict[str, Any]]) -> None:
    """Check that all sides report the same losses.

    Args:
        facts: Facts of each side by name; losses that a side does not report are not compared.

    Raises:
        SideError: A loss differs by more than the tolerance.
    """
    for part in LOSSES:
        values = {name: fact[part] for name, fact in facts.items() if part in fact}
        if values and not math.isclose(*_ends(values.values()), rel_tol=LOSS_TOLERANCE):
            raise SideError(
                f"The sides compute different values of {part} from the same weights and batch: {values}. Expected a "
                f"relative difference of at most {LOSS_TOLERANCE:g}, so their times cannot be compared."
            )


def write_rows(module: str, rows: list[dict[str, Any]], output: Path | None) -> None:
    """Print the rows of a module's command with their provenance as JSON, and write them to `output` if given."""
    source = {**provenance(), "command": f"python -m {module} {shlex.join(sys.argv[1:])}"}
    text = json.dumps({"provenance": source, "rows": rows}, indent=2)
    print(text)
    if output is not None:
        output.write_text(text + "\n")


def _ends(values: Collection[float]) -> tuple[float, float]:
    return min(values), max(values)
