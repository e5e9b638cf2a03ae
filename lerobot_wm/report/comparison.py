"""Paired comparison of two arms on the variations that both were rolled out on."""

from collections.abc import Container, Iterable
from dataclasses import dataclass

import numpy as np
from scipy.stats import binomtest
from scipy.stats import t as student_t

from lerobot_wm.records import RNG_SEED, Record, percentile_interval, resample
from lerobot_wm.report.arms import ARMS, WM_RSSM

# Each of these is compared with every other arm.
COMPARED_ARMS = ("wm_iql", "wm_bc")
DENSE_SUFFIX = "_dense"
# Arms of one training seed share one world model. wm_proprio_bc has its own.
SHARING_WORLD_MODEL = frozenset(arm.name for arm in ARMS.values() if arm.encoder is WM_RSSM)


def group_by_arm(records: Iterable[Record]) -> dict[str, list[Record]]:
    """Group records by arm: arms in the order of `ARMS`, then others in the order they occur."""
    groups: dict[str, list[Record]] = {}
    for record in records:
        groups.setdefault(record["arm"], []).append(record)
    known = [arm for arm in ARMS if arm in groups]
    return {arm: groups[arm] for arm in dict.fromkeys([*known, *groups])}


# Where McNemar's test can be made, its p value must be below this for arms to be called different.
SIGNIFICANCE = 0.05


@dataclass(frozen=True)
class Comparison:
    """Success of `arm` minus that of `other`, in percentage points.

    Attributes:
        arm, other: The arms.
        n_pairs: Pairs of rollouts that were compared.
        difference: Mean difference.
        interval: 95% interval over the choice of variations.
        seed_interval: 95% interval over training seeds; None where an arm has one seed.
        only_arm, only_other: Pairs in which only that arm succeeded.
        p_value: Of the exact McNemar test; None where an arm has several seeds, which makes pairs dependent.
    """

    arm: str
    other: str
    n_pairs: int
    difference: float
    interval: tuple[float, float]
    seed_interval: tuple[float, float] | None
    only_arm: int
    only_other: int
    p_value: float | None

    @property
    def verdict(self) -> str:
        """The comparison in words.

        The bootstrap interval is too narrow where few pairs differ: with four won and none lost it excludes zero at
        p 0.125, so the McNemar test decides too.
        """
        intervals = [self.interval, *([self.seed_interval] if self.seed_interval else [])]
        includes_zero = any(low <= 0 <= high for low, high in intervals)
        if includes_zero or (self.p_value is not None and self.p_value >= SIGNIFICANCE):
            return "no difference shown"
        excludes = "intervals exclude" if len(intervals) > 1 else "interval excludes"
        return f"{'better' if self.difference > 0 else 'worse'} ({excludes} zero)"


def compare(records: list[Record], others: list[Record]) -> Comparison | None:
    """Compare two arms over the variations that both were rolled out on; None where they share none.

    Each seed of one arm is paired with each seed of the other: equal seeds make two runs no more alike than unequal
    ones, and a single pair could be a lucky one. Only arms on a shared world model (`SHARING_WORLD_MODEL`) are paired
    seed by seed, since there a seed stands for one world model.

    The difference is averaged over the pairs of a variation, the variations of a task, and the tasks. `interval` is a
    percentile bootstrap that resamples variations within each task, each with all of its pairs, since rollouts on one
    variation are not independent. `seed_interval` is a t interval over the seeds' success on these variations: Welch's
    for two samples, or that of the differences between arms on a shared world model.
    """
    arm, other = records[0]["arm"], others[0]["arm"]
    seed_by_seed = {arm, other} <= SHARING_WORLD_MODEL
    ours, theirs = _by_variation(records), _by_variation(others)
    seed_pairs: set[tuple[int | None, int | None]] = set()
    # Task -> each variation's differences.
    pairs: dict[str, list[list[int]]] = {}
    for task, variation in sorted(ours.keys() & theirs.keys(), key=str):
        found = {
            (seed, other_seed): success - other_success
            for seed, success in ours[task, variation].items()
            for other_seed, other_success in theirs[task, variation].items()
            if not seed_by_seed or seed == other_seed
        }
        if found:
            pairs.setdefault(task, []).append(list(found.values()))
            seed_pairs |= found.keys()
    if not pairs:
        return None
    rng = np.random.default_rng(RNG_SEED)
    differences, draws = [], []
    for variations in pairs.values():
        clusters = np.array([np.mean(found) for found in variations])  # (V,)
        differences.append(clusters.mean())
        draws.append(resample(clusters, rng).mean(axis=1))  # (N,)
    flat = [pair for variations in pairs.values() for found in variations for pair in found]
    only_arm, only_other = flat.count(1), flat.count(-1)
    return Comparison(
        arm=arm,
        other=other,
        n_pairs=len(flat),
        difference=100 * float(np.mean(differences)),
        interval=percentile_interval(100 * np.mean(draws, axis=0)),
        seed_interval=_interval_over_seeds(
            _rates(ours, {seed for seed, _ in seed_pairs}, theirs),
            _rates(theirs, {seed for _, seed in seed_pairs}, ours),
            seed_by_seed,
        ),
        only_arm=only_arm,
        only_other=only_other,
        p_value=_mcnemar(only_arm, only_other) if len(seed_pairs) == 1 else None,
    )


def compare_arms(records: list[Record]) -> dict[str, list[Comparison]]:
    """Compare each arm of `COMPARED_ARMS` with every other arm that shares variations with it, in table order."""
    arms = group_by_arm(records)
    compared = {
        arm: [compare(arms[arm], arms[other]) for other in arms if other != arm]
        for arm in COMPARED_ARMS
        if arm in arms
    }
    found = {arm: [c for c in results if c is not None] for arm, results in compared.items()}
    return {arm: results for arm, results in found.items() if results}


def _by_variation(records: list[Record]) -> dict[tuple[str, int], dict[int | None, bool]]:
    """Success by (task, variation), then by training seed."""
    found: dict[tuple[str, int], dict[int | None, bool]] = {}
    for record in records:
        found.setdefault((record["task"], record["variation"]), {})[record["seed"]] = record["success"]
    return found


def _rates(
    found: dict[tuple[str, int], dict[int | None, bool]],
    seeds: set[int | None],
    shared: Container[tuple[str, int]],
) -> list[float]:
    """Success of each seed in percent, in the order of seeds: on the shared variations, averaged over tasks."""
    rates = []
    for seed in sorted(seeds, key=str):
        of_task: dict[str, list[bool]] = {}
        for (task, variation), successes in found.items():
            if (task, variation) in shared and seed in successes:
                of_task.setdefault(task, []).append(successes[seed])
        rates.append(100 * float(np.mean([np.mean(successes) for successes in of_task.values()])))
    return rates


def _interval_over_seeds(ours: list[float], theirs: list[float], paired: bool) -> tuple[float, float] | None:
    """95% t interval of the difference between the means over seeds; None where an arm has one seed.

    SciPy's Welch interval would warn where all seeds of an arm succeed equally often, which is common here.
    """
    if min(len(ours), len(theirs)) < 2:
        return None
    samples = [np.subtract(ours, theirs)] if paired else [np.asarray(ours), np.asarray(theirs)]
    squared_errors = np.array([np.var(sample, ddof=1) / len(sample) for sample in samples])
    degrees = np.array([len(sample) - 1 for sample in samples])
    difference = float(np.mean(ours) - np.mean(theirs))
    total = squared_errors.sum()
    if np.isclose(total, 0):
        return difference, difference
    freedom = total**2 / (squared_errors**2 / degrees).sum()
    half = float(student_t.ppf(0.975, freedom) * np.sqrt(total))
    return difference - half, difference + half


def _mcnemar(only_arm: int, only_other: int) -> float:
    """Two-sided exact McNemar test: if the arms are equal, each pair that differs is a fair coin (McNemar 1947)."""
    discordant = only_arm + only_other
    return float(binomtest(only_arm, discordant).pvalue) if discordant else 1.0
