"""Timing for all sides. Imports only the standard library, because peers' environments lack our packages."""

import time
from collections.abc import Callable
from dataclasses import dataclass, field


@dataclass(frozen=True)
class Prepared:
    """A side that is ready to be timed.

    Attributes:
        measure: Measures once and returns a value in the row's unit.
        facts: What the side reports about itself, such as its loss; stored with the result.
    """

    measure: Callable[[], float]
    facts: dict[str, float | str] = field(default_factory=dict)


def rate(step: Callable[[], int], seconds: float) -> float:
    """Repeat `step`, which returns a number of units, for some seconds and at least once; return units per second."""
    units = 0
    start = time.perf_counter()
    while True:
        units += step()
        elapsed = time.perf_counter() - start
        if elapsed >= seconds:
            return units / elapsed


def timed_updates(update: Callable[[], object], seconds: float, facts: dict[str, float | str]) -> Prepared:
    """Make a side that counts updates; two slow first updates are not timed."""

    def step() -> int:
        update()
        return 1

    for _ in range(2):
        update()
    return Prepared(lambda: rate(step, seconds), facts)
