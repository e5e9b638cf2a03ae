"""Paired comparisons: known differences, clusters of seeds, and how often the interval holds the truth."""

from collections.abc import Callable

import numpy as np
import pytest
from scipy.stats import ttest_1samp, ttest_ind

from lerobot_wm.records import Record
from lerobot_wm.report.comparison import compare, compare_arms

TASKS = {"reach-v3": (5, 20), "window-close-v3": (10, 30)}


def with_outcomes(records: list[Record], outcomes: np.ndarray) -> list[Record]:
    return [record | {"success": bool(success)} for record, success in zip(records, outcomes, strict=True)]


def test_known_difference_and_mcnemar(make_records: Callable) -> None:
    ours = make_records("wm_bc", {"reach-v3": (10, 8)})
    theirs = make_records("proprio_bc", {"reach-v3": (5, 5)})
    found = compare(ours, theirs)
    assert (found.arm, found.other, found.n_pairs) == ("wm_bc", "proprio_bc", 50)
    assert found.difference == pytest.approx(16)
    assert (found.only_arm, found.only_other) == (8, 0)
    assert found.p_value == pytest.approx(2 / 2**8)
    assert found.verdict.startswith("better")

    reverse = compare(theirs, ours)
    assert reverse.difference == pytest.approx(-16)
    assert reverse.interval == pytest.approx((-found.interval[1], -found.interval[0]), abs=2)
    assert reverse.verdict.startswith("worse")


def test_what_mcnemars_test_does_not_tell_apart_is_not_called_better(make_records: Callable) -> None:
    found = compare(
        make_records("wm_bc", {"reach-v3": (10, 34)}), make_records("wm_iql", {"reach-v3": (10, 30)})
    )
    assert (found.only_arm, found.only_other, found.p_value) == (4, 0, 0.125)
    assert found.interval[0] > 0
    assert found.verdict.startswith("no difference")


def test_equal_arms(make_records: Callable) -> None:
    found = compare(make_records("wm_bc", TASKS), make_records("wm_iql", TASKS))
    assert (found.difference, found.interval, found.p_value) == (0, (0, 0), 1)
    assert found.verdict.startswith("no difference")


def test_tasks_weigh_the_same(make_records: Callable) -> None:
    ours = [r for r in make_records("a", {"x": (10, 40), "y": (0, 0)}) if r["task"] == "x" or r["seen"]]
    assert compare(ours, make_records("b", {"x": (0, 0), "y": (0, 0)})).difference == pytest.approx(50)


def test_seeds_of_one_variation_are_not_independent(make_records: Callable) -> None:
    """Five seeds that do the very same must not narrow the interval."""

    def five(arm: str, successes: dict) -> list[Record]:
        return [r for seed in range(5) for r in make_records(arm, successes, seed)]

    other = {"reach-v3": (2, 10), "window-close-v3": (9, 10)}
    one = compare(make_records("wm_bc", TASKS), make_records("e2e_bc", other))
    several = compare(five("wm_bc", TASKS), five("e2e_bc", other))
    assert several.n_pairs == 5 * 5 * one.n_pairs
    assert several.interval == pytest.approx(one.interval)
    assert several.p_value is None


def runs(arm: str, successes: list[int]) -> list[Record]:
    """Seeds with so many successes on 40 variations of one task."""
    return [
        {"arm": arm, "seed": seed, "task": "reach-v3", "variation": k, "success": k < n}
        for seed, n in enumerate(successes)
        for k in range(40)
    ]


def test_the_interval_over_seeds_is_welchs() -> None:
    """Two lucky seeds of three win on almost all variations, and say nothing about the next seed."""
    ours, theirs = [30, 30, 10], [16, 17, 18]
    found = compare(runs("wm_bc", ours), runs("e2e_bc", theirs))
    assert found.interval[0] > 0
    t = ttest_ind([n / 0.4 for n in ours], [n / 0.4 for n in theirs], equal_var=False)
    assert found.seed_interval == pytest.approx(tuple(t.confidence_interval()))
    assert found.seed_interval[0] < 0
    assert found.verdict.startswith("no difference")
    steady = compare(runs("wm_bc", [30, 29, 31]), runs("e2e_bc", theirs))
    assert steady.seed_interval[0] > 0
    assert steady.verdict.startswith("better")
    assert compare(runs("e2e_bc", theirs), runs("wm_bc", [30, 29, 31])).verdict.startswith("worse")
    assert compare(runs("wm_bc", ours), runs("e2e_bc", [17])).seed_interval is None


def test_seeds_on_a_shared_world_model_differ_together() -> None:
    """A world model that is good for both arms adds nothing to the spread of their difference."""
    shared = compare(runs("wm_bc", [10, 20, 31]), runs("wm_iql", [8, 18, 28]))
    assert shared.seed_interval == pytest.approx(tuple(ttest_1samp([5, 5, 7.5], 0).confidence_interval()))
    assert compare(runs("wm_bc", [10, 20, 30]), runs("wm_iql", [8, 18, 28])).seed_interval == (5, 5)


def test_only_shared_rollouts_count(make_records: Callable) -> None:
    """Arms on the same world model share the world model of a seed."""
    ours = make_records("wm_bc", TASKS, seed=0) + make_records("wm_bc", {"reach-v3": (0, 0)}, seed=1)
    theirs = make_records("wm_bc_single", {"reach-v3": (5, 20)}, seed=0)
    found = compare(ours, theirs)
    assert (found.n_pairs, found.difference) == (50, 0)
    assert found.p_value == 1, "one shared seed: the pairs are independent"
    assert compare(ours, make_records("wm_bc_single", TASKS, seed=7)) is None


def test_each_seed_is_compared_with_each_of_the_other_arm(make_records: Callable) -> None:
    """Equal numbers or not: a lucky seed 0 is no better evidence than an unlucky seed 1."""
    lucky, unlucky = (
        make_records("wm_bc", {"reach-v3": outcomes}, seed) for seed, outcomes in ((0, (10, 40)), (1, (0, 0)))
    )
    for seed in (0, 7):
        once = make_records("state_bc", {"reach-v3": (5, 20)}, seed)
        found = compare(lucky + unlucky, once)
        assert (found.n_pairs, found.difference, found.p_value) == (100, 0, None)
        assert (found.only_arm, found.only_other) == (25, 25)
        assert compare(once, lucky + unlucky).difference == 0
    assert compare(lucky, once).p_value < 0.001, "one seed of each: the pairs are independent"


def test_equal_seeds_of_unrelated_arms_are_not_paired(make_records: Callable) -> None:
    """Two seeds of each: seed 0 of one arm has nothing in common with seed 0 of the other."""
    rng = np.random.default_rng(0)
    ours = [
        with_outcomes(run, rng.random(100) < 0.7) for run in (make_records("wm_bc", TASKS, s) for s in (0, 1))
    ]
    theirs = [make_records("e2e_bc", {"reach-v3": (9, 39), "window-close-v3": (1, 2)}, s) for s in (0, 1)]
    theirs[1] = with_outcomes(theirs[1], rng.random(100) < 0.4)
    straight = compare(ours[0] + ours[1], theirs[0] + theirs[1])
    renumbered = [[r | {"seed": 1 - r["seed"]} for r in run] for run in theirs]
    assert straight == compare(ours[0] + ours[1], renumbered[0] + renumbered[1])
    assert (straight.n_pairs, straight.p_value) == (400, None)
    mean = [np.mean([r["success"] for run in runs for r in run]) for runs in (ours, theirs)]
    assert straight.difference == pytest.approx(100 * (mean[0] - mean[1]))


def test_arms_on_a_shared_world_model_are_paired_by_seed(make_records: Callable) -> None:
    """The variant with its own world model is not: its one seed is paired with all of ours."""
    ours = [r for seed in (0, 1) for r in make_records("wm_bc", TASKS, seed)]
    assert compare(ours, make_records("wm_iql_beta0", TASKS, 1)).n_pairs == 100
    assert compare(ours, make_records("wm_proprio_bc", TASKS, 1)).n_pairs == 200


def test_world_model_arms_are_compared_with_every_other(make_records: Callable) -> None:
    records = [r for arm in ("mine", "proprio_bc", "wm_bc", "e2e_iql") for r in make_records(arm, TASKS)]
    elsewhere = make_records("wm_bc_single", TASKS, seed=3)
    found = compare_arms(records + elsewhere)
    assert {arm: [c.other for c in results] for arm, results in found.items()} == {
        "wm_bc": ["e2e_iql", "proprio_bc", "mine"]
    }
    assert compare_arms(make_records("wm_bc", TASKS)) == {}


def test_the_interval_holds_the_truth(make_records: Callable) -> None:
    """Variations of three seeds share their difficulty; the expected difference over variations is the truth."""
    rng = np.random.default_rng(0)
    ours = [r for seed in range(3) for r in make_records("wm_bc", TASKS, seed)]  # (3 seeds, 2 tasks, 50)
    theirs = [r | {"arm": "e2e_bc"} for r in ours]
    hits = 0
    for _ in range(100):
        chance = np.tile(rng.beta(2, 1, 100), 3)
        other = np.tile(rng.beta(1, 1, 100), 3)
        found = compare(
            with_outcomes(ours, rng.random(300) < chance), with_outcomes(theirs, rng.random(300) < other)
        )
        hits += found.interval[0] <= 100 * (2 / 3 - 1 / 2) <= found.interval[1]
    assert hits >= 88
