"""Sides measured by turns, each in its own process, and what is said of their values."""

import json
import math
import os
import statistics
import subprocess
from collections.abc import Collection, Sequence
from contextlib import ExitStack, suppress
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

from benchmarks.environments import ROOT, python_of
from benchmarks.rows import Row, Side, Size

LOSS_TOLERANCE = 1e-4  # relative: the same model in another order of additions
# Fresh weights draw nearly nothing, whatever the layers: it is the gradient that tells two architectures apart.
LOSSES = ("loss", "image_loss", "reward_loss", "kl", "gradient_norm")
THREAD_VARIABLES = ("OMP_NUM_THREADS", "MKL_NUM_THREADS", "OPENBLAS_NUM_THREADS", "LP_NUM_THREADS")


class SideError(RuntimeError):
    """A side ended before it answered, or two sides do not compute the same."""


@dataclass(frozen=True)
class Spread:
    """Median and range of a side's values, in the row's unit."""

    median: float
    low: float
    high: float

    @classmethod
    def of(cls, values: Sequence[float]) -> "Spread":
        """Of at least one value."""
        return cls(statistics.median(values), min(values), max(values))


@dataclass(frozen=True)
class Result:
    """A row at one size against one peer, in the form of results/benchmarks.

    Attributes:
        row: The row's name.
        ours: Our median.
        peer: The peer's median; None for a row without one.
        peer_name: Its name.
        ratio: How many times faster ours is.
        unit: Of `ours` and `peer`.
        sizes: Parameters of the row and the number of threads.
        repeats: Values of each side.
        spread: The lowest and highest value of each side.
        facts: What each side says of itself.
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
    """How many times faster ours is, from values in one unit."""
    return peer / ours if less_is_better else ours / peer


class SideProcess:
    """A side running `benchmarks.side`, prepared and waiting to be asked."""

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
        self._process.communicate()  # closes its standard input, which ends it

    def measure(self) -> float:
        """One value."""
        assert self._process.stdin is not None
        with suppress(BrokenPipeError):  # it ended meanwhile, and gives no answer
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
    """One row at one size: a result for each peer, or one for a row without peers.

    Args:
        row: What to measure.
        size: One of its sizes, scaled.
        folder: Where sides put their data; sides of all rows find there what others made.
        threads: Threads of each side's process.
        repeats: How many times each side is measured, by turns.

    Raises:
        SideError: A side failed, or the sides do not compute the same.
    """
    sides = (row.ours, *row.peers)
    with ExitStack() as running:
        # One after the other: ours first, whose data and weights a peer reads.
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
    """Refuse to compare sides that report losses, or parts of them, which differ.

    Args:
        facts: Of each side, by its name; what a side does not report is not compared.

    Raises:
        SideError: Names the part and both values.
    """
    for part in LOSSES:
        values = {name: fact[part] for name, fact in facts.items() if part in fact}
        if values and not math.isclose(*_ends(values.values()), rel_tol=LOSS_TOLERANCE):
            raise SideError(
                f"The sides compute different values of {part} from the same weights and batch: {values}; expected a "
                f"relative difference of at most {LOSS_TOLERANCE:g}. Their times cannot be compared."
            )


def _ends(values: Collection[float]) -> tuple[float, float]:
    return min(values), max(values)
