"""Sides of rows for the tests of `benchmarks`: real processes that answer at once and note that they were asked."""

import os
import threading
import time
from pathlib import Path

from benchmarks.timing import Prepared

ORDER = "order.txt"


def _noting(folder: Path, name: str, values: list[float], loss: float) -> Prepared:
    print(f"{name} chatters on standard output")
    remaining = iter(values)

    def measure() -> float:
        with (folder / ORDER).open("a") as file:
            file.write(f"{name} ")
        return next(remaining)

    return Prepared(measure, {"loss": loss})


def ours(folder: Path, batch: int, seconds: float) -> Prepared:
    return _noting(folder, "ours", [10.0, 40.0, 20.0], loss=100.0)


def peer(folder: Path, batch: int, seconds: float) -> Prepared:
    return _noting(folder, "peer", [5.0, 4.0, 6.0], loss=100.001)


def stranger(folder: Path, batch: int, seconds: float) -> Prepared:
    return _noting(folder, "stranger", [1.0], loss=101.0)


def broken(folder: Path, batch: int, seconds: float) -> Prepared:
    raise ValueError(f"no batch of {batch} for you")


def slow(folder: Path, batch: int, seconds: float) -> Prepared:
    return Prepared(lambda: time.sleep(1.0) or 1.0, {})


def mortal(folder: Path, batch: int, seconds: float) -> Prepared:
    return Prepared(lambda: threading.Timer(0.1, os._exit, [9]).start() or 1.0, {})
