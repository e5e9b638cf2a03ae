"""Paired comparison of two arms over the rollouts that both made."""

from dataclasses import dataclass

import numpy as np
from scipy.stats import binomtest

from lerobot_wm.report.arms import COMPARED_ARMS, SHARING_WORLD_MODEL, by_arm
from lerobot_wm.report.bootstrap import RNG_SEED, percentile_interval, resample
from lerobot_wm.report.records import Record

SIGNIFICANCE = 0.05  # McNemar's test below which arms are called different, where it can be made


@dataclass(frozen=True)
class Comparison:
    """Success of `arm` minus that of `other`, in percentage points, over `n_pairs` rollouts of each.

    `only_arm` and `only_other` count the pairs where just that one succeeded. `p_value` is that of the exact
    McNemar test, None where several trainings of an arm make the pairs of a variation dependent.
    """

    arm: str
    other: str
    n_pairs: int
    difference: float
    interval: tuple[float, float]
    only_arm: int
    only_other: int
    p_value: float | None

    @property
    def verdict(self) -> str:
        """The comparison in words.

        The bootstrap is too sure of itself where few pairs differ: four won and none lost exclude zero at p 0.125.
        """
        low, high = self.interval
        if low <= 0 <= high or (self.p_value is not None and self.p_value >= SIGNIFICANCE):
            return "no difference shown"
        return f"{'better' if low > 0 else 'worse'} (interval excludes zero)"


def compare(records: list[Record], others: list[Record]) -> Comparison | None:
    """Compare two arms over the variations that both were rolled out on; None where they share none.

    Each training of the one is paired with each of the other: equal training seeds make two trainings no more alike
    than unequal ones, and picking one would compare with a lucky or an unlucky one. Only arms on a shared world model
    (`SHARING_WORLD_MODEL`) are paired seed by seed: there a seed is one world model, good or bad for both.

    The difference is averaged over the pairs of a variation, the variations of a task and then the tasks. The interval
    is a percentile bootstrap that resamples variations within each task: a variation is drawn with all of its pairs,
    since rollouts on one variation are not independent. It covers the choice of variations; the trainings are taken as
    they are.
    """
    arm, other = records[0]["arm"], others[0]["arm"]
    seed_by_seed = {arm, other} <= SHARING_WORLD_MODEL
    ours, theirs = _by_variation(records), _by_variation(others)
    trainings: set[tuple[int | None, int | None]] = set()
    pairs: dict[str, list[list[int]]] = {}  # task -> variation -> differences of its pairs
    for task, variation in sorted(ours.keys() & theirs.keys(), key=str):
        found = {
            (seed, other_seed): success - other_success
            for seed, success in ours[task, variation].items()
            for other_seed, other_success in theirs[task, variation].items()
            if not seed_by_seed or seed == other_seed
        }
        if found:
            pairs.setdefault(task, []).append(list(found.values()))
            trainings |= found.keys()
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
        only_arm=only_arm,
        only_other=only_other,
        p_value=_mcnemar(only_arm, only_other) if len(trainings) == 1 else None,
    )


def compare_arms(records: list[Record]) -> dict[str, list[Comparison]]:
    """Each arm of `COMPARED_ARMS` against every other arm that shares rollouts with it, in the order of tables."""
    arms = by_arm(records)
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


def _mcnemar(only_arm: int, only_other: int) -> float:
    """Two-sided exact McNemar test: under equality each discordant pair is a fair coin (McNemar 1947)."""
    discordant = only_arm + only_other
    return float(binomtest(only_arm, discordant).pvalue) if discordant else 1.0
