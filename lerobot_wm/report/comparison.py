"""Paired comparison of two arms over the rollouts that both made."""

from dataclasses import dataclass

import numpy as np
from scipy.stats import binomtest

from lerobot_wm.report.arms import COMPARED_ARMS, by_arm, on_one_world_model
from lerobot_wm.report.bootstrap import RNG_SEED, percentile_interval, resample
from lerobot_wm.report.records import Record

type Outcomes = dict[tuple[int | None, str, int], bool]  # (seed, task, variation) -> success

SIGNIFICANCE = 0.05  # McNemar's test below which arms are called different, where it can be made


@dataclass(frozen=True)
class Comparison:
    """Success of `arm` minus that of `other`, in percentage points, over `n_pairs` rollouts of each.

    `only_arm` and `only_other` count the pairs where just that one succeeded. `p_value` is that of the exact
    McNemar test, None where the pairs come from several training seeds and are not independent.
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
    """Compare two arms over the rollouts (seed, task, variation) that both have; None where they share none.

    An arm of one training seed is compared with every training of the other: picking the one of equal number would
    compare with a lucky or an unlucky one. Not so arms on the same world model, which share the training of a seed.

    The difference is averaged over the shared seeds of a variation, the variations of a task and then the tasks. The
    interval is a percentile bootstrap that resamples variations within each task: a variation is drawn with all of
    its seeds, since rollouts on one variation are not independent. It covers the choice of variations; the training
    seeds are taken as they are.
    """
    ours, theirs = _outcomes(records), _outcomes(others)
    if not on_one_world_model(records[0]["arm"], others[0]["arm"]):
        ours = _for_every_seed(ours, theirs)
        theirs = _for_every_seed(theirs, ours)
    shared = sorted(ours.keys() & theirs.keys(), key=str)
    if not shared:
        return None
    by_variation: dict[str, dict[int, list[int]]] = {}  # task -> variation -> differences by seed
    for seed, task, variation in shared:
        pair = (seed, task, variation)
        by_variation.setdefault(task, {}).setdefault(variation, []).append(ours[pair] - theirs[pair])
    rng = np.random.default_rng(RNG_SEED)
    differences, draws = [], []
    for variations in by_variation.values():
        clusters = np.array([np.mean(seeds) for seeds in variations.values()])  # (V,)
        differences.append(clusters.mean())
        draws.append(resample(clusters, rng).mean(axis=1))  # (N,)
    only_arm = sum(ours[pair] > theirs[pair] for pair in shared)
    only_other = sum(ours[pair] < theirs[pair] for pair in shared)
    single_seed = len({seed for seed, _, _ in shared}) == 1
    return Comparison(
        arm=records[0]["arm"],
        other=others[0]["arm"],
        n_pairs=len(shared),
        difference=100 * float(np.mean(differences)),
        interval=percentile_interval(100 * np.mean(draws, axis=0)),
        only_arm=only_arm,
        only_other=only_other,
        p_value=_mcnemar(only_arm, only_other) if single_seed else None,
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


def _outcomes(records: list[Record]) -> Outcomes:
    return {(record["seed"], record["task"], record["variation"]): record["success"] for record in records}


def _for_every_seed(outcomes: Outcomes, others: Outcomes) -> Outcomes:
    """The outcomes, of one training seed, under each of the others' seeds; of several, as they are."""
    if len({seed for seed, _, _ in outcomes}) > 1:
        return outcomes
    seeds = {seed for seed, _, _ in others}
    return {
        (seed, task, variation): success
        for (_, task, variation), success in outcomes.items()
        for seed in seeds
    }


def _mcnemar(only_arm: int, only_other: int) -> float:
    """Two-sided exact McNemar test: under equality each discordant pair is a fair coin (McNemar 1947)."""
    discordant = only_arm + only_other
    return float(binomtest(only_arm, discordant).pvalue) if discordant else 1.0
