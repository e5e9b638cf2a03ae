"""What every side shares. It imports nothing but Python's own library: peers' environments have nothing of ours."""

import time
from collections.abc import Callable
from dataclasses import dataclass, field


@dataclass(frozen=True)
class Prepared:
    """A side that is ready to be timed.

    Attributes:
        measure: Runs once and returns one value in the row's unit.
        facts: What the side says of itself, such as the loss it computes; kept beside the result.
    """

    measure: Callable[[], float]
    facts: dict[str, float | str] = field(default_factory=dict)


def rate(step: Callable[[], int], seconds: float) -> float:
    """Repeat `step`, which returns how many units it did, for some seconds, at least once; units per second."""
    units = 0
    start = time.perf_counter()
    while True:
        units += step()
        elapsed = time.perf_counter() - start
        if elapsed >= seconds:
            return units / elapsed


def timed_updates(update: Callable[[], object], seconds: float, facts: dict[str, float | str]) -> Prepared:
    """A side whose unit is one update; the first ones, slower than the rest, are not timed."""

    def step() -> int:
        update()
        return 1

    for _ in range(2):
        update()
    return Prepared(lambda: rate(step, seconds), facts)
