"""Success rates with Wilson score intervals (Wilson 1927), over any selection of records."""

from collections.abc import Iterable
from dataclasses import dataclass

import numpy as np
from scipy.stats import binomtest, trim_mean

from lerobot_wm.records import Record, by_task

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


N_RESAMPLES = 10_000
RNG_SEED = 0  # the same records give the same intervals


@dataclass(frozen=True)
class Estimate:
    """A statistic of success rates and its 95% interval, in percent."""

    percent: float
    interval: tuple[float, float]

    def __str__(self) -> str:
        low, high = self.interval
        return f"{self.percent:.0f} [{low:.0f}, {high:.0f}]"


@dataclass(frozen=True)
class RunStatistics:
    """Mean and IQM of an arm's scores; a score is the success rate of one run (training seed) on one task."""

    mean: Estimate
    iqm: Estimate
    single_run: bool  # some task has one run only: there its variations were resampled, not its runs


def run_statistics(records: list[Record]) -> RunStatistics:
    """Mean and IQM over the scores of one arm, with percentile intervals of the stratified bootstrap.

    What is resampled, with replacement and independently within each task: the runs' scores. The interval then covers
    the spread between training seeds, on these variations. It is too narrow for a handful of runs, and knows nothing of
    the weights that the tasks of one multi-task run share (tests/report/test_bootstrap.py measures both). Where a task
    has one run, the rollouts (variations) of that run are resampled instead: the interval covers the choice of
    variations, not the spread between seeds. Scores that are all alike leave an interval without width.
    """
    rng = np.random.default_rng(RNG_SEED)
    scores, draws, single_run = [], [], False
    for of_task in by_task(records).values():
        outcomes: dict[int | None, list[bool]] = {}
        for record in of_task:
            outcomes.setdefault(record["seed"], []).append(record["success"])
        task_scores = np.array([np.mean(run) for run in outcomes.values()])  # (R,)
        if len(task_scores) > 1:
            task_draws = resample(task_scores, rng)  # (N, R)
        else:
            [run] = outcomes.values()
            task_draws = resample(np.array(run, float), rng).mean(axis=1, keepdims=True)  # (N, 1)
            single_run = True
        scores.append(task_scores)
        draws.append(task_draws)
    all_scores, all_draws = np.concatenate(scores), np.concatenate(draws, axis=1)  # (R·T,), (N, R·T)
    return RunStatistics(
        mean=Estimate(100 * all_scores.mean(), percentile_interval(100 * all_draws.mean(axis=1))),
        iqm=Estimate(
            100 * trim_mean(all_scores, 0.25), percentile_interval(100 * trim_mean(all_draws, 0.25, axis=1))
        ),
        single_run=single_run,
    )


def resample(values: np.ndarray, rng: np.random.Generator) -> np.ndarray:
    """Draw from the values (n,) with replacement: (N_RESAMPLES, n)."""
    return values[rng.integers(len(values), size=(N_RESAMPLES, len(values)))]


def percentile_interval(draws: np.ndarray) -> tuple[float, float]:
    """The 95% percentile interval of a statistic's bootstrap draws (N_RESAMPLES,)."""
    low, high = np.percentile(draws, (2.5, 97.5))
    return float(low), float(high)
