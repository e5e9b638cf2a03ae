"""Success rates with Wilson score intervals (Wilson 1927), over any selection of records."""

from collections.abc import Iterable
from dataclasses import dataclass

from scipy.stats import binomtest

from lerobot_wm.report.records import Record

SPLITS = ("seen", "unseen", "all")


@dataclass(frozen=True)
class SuccessRate:
    """`successes` out of `n` independent rollouts, `n` >= 1."""

    successes: int
    n: int

    @property
    def percent(self) -> float:
        """Successes in percent of the rollouts."""
        return 100 * self.successes / self.n

    @property
    def interval(self) -> tuple[float, float]:
        """Wilson 95% interval in percent; it stays inside [0, 100] and holds for rates near 0 and 100."""
        bounds = binomtest(self.successes, self.n).proportion_ci(confidence_level=0.95, method="wilson")
        return 100 * bounds.low, 100 * bounds.high

    def __str__(self) -> str:
        low, high = self.interval
        return f"{self.successes}/{self.n}  {self.percent:.0f} [{low:.0f}, {high:.0f}]"


def success_rate(records: Iterable[Record]) -> SuccessRate | None:
    """The success rate over these records; None when there are none."""
    outcomes = [record["success"] for record in records]
    return SuccessRate(sum(outcomes), len(outcomes)) if outcomes else None


def in_split(record: Record, split: str) -> bool:
    """Whether a record belongs to the split "seen", "unseen" or "all"; `seen` None belongs to "all" only."""
    return split == "all" or record["seen"] is (split == "seen")


def ci95_summary(records: Iterable[Record]) -> dict[str, int | float | list[float]]:
    """The rate under the keys of LeRobot's evaluation output: percentages, the interval as [low, high]."""
    rate = success_rate(records)
    if rate is None:
        raise ValueError("No rollouts to summarise.")
    return {
        "n_episodes": rate.n,
        "n_success": rate.successes,
        "pc_success": rate.percent,
        "pc_success_ci95": list(rate.interval),
    }
