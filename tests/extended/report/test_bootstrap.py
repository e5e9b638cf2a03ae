"""The stratified bootstrap over seeds x tasks: known values, and how often its intervals hold the truth."""

from collections.abc import Callable

import numpy as np
import pytest

from lerobot_wm.records import Record, run_statistics

CHANCES = np.array([0.9, 0.95, 0.97, 0.5, 0.98, 0.85])  # of success on six tasks
SIMULATIONS = 100


def simulated(rng: np.random.Generator, logits: np.ndarray) -> list[Record]:
    """Fifty rollouts for each chance of success, logits (seeds, tasks)."""
    outcomes = rng.random((*logits.shape, 50)) < 1 / (1 + np.exp(-logits))[..., None]
    return [
        {"arm": "a", "seed": seed, "task": f"task {task}", "variation": variation, "success": bool(success)}
        for (seed, task, variation), success in np.ndenumerate(outcomes)
    ]


def coverage(n_seeds: int, of_run: float, of_seed: float) -> float:
    """Share of 95% intervals of the mean that hold the truth.

    `of_run` is the deviation (logits) of each run on each task, `of_seed` that of a seed on all of its tasks.
    """
    rng = np.random.default_rng(0)
    logits = np.log(CHANCES / (1 - CHANCES))
    many = logits + rng.normal(0, np.hypot(of_run, of_seed), (100_000, 1))
    truth = 100 * (1 / (1 + np.exp(-many))).mean()
    hits = 0
    for _ in range(SIMULATIONS):
        runs = logits + rng.normal(0, of_run, (n_seeds, len(CHANCES))) + rng.normal(0, of_seed, (n_seeds, 1))
        low, high = run_statistics(simulated(rng, runs)).mean.interval
        hits += low <= truth <= high
    return hits / SIMULATIONS


def test_one_seed_covers_the_choice_of_variations() -> None:
    assert coverage(1, of_run=0, of_seed=0) > 0.88


@pytest.mark.slow
def test_seeds_cover_the_truth_when_there_are_enough() -> None:
    assert coverage(10, of_run=0.5, of_seed=0) > 0.88


@pytest.mark.slow
def test_what_the_report_says_of_three_seeds() -> None:
    assert coverage(3, of_run=0.5, of_seed=0) == pytest.approx(0.8, abs=0.08)
    assert coverage(3, of_run=0, of_seed=0.5) == pytest.approx(0.6, abs=0.1)


def test_mean_and_iqm_of_one_seed(make_records: Callable) -> None:
    # Rates 0, .2, .5, 1: the middle half are .2 and .5.
    tasks = {"a": (0, 0), "b": (0, 10), "c": (5, 20), "d": (10, 40)}
    statistics = run_statistics(make_records("wm_bc", tasks))
    assert statistics.mean.percent == pytest.approx(42.5)
    assert statistics.iqm.percent == pytest.approx(35)
    assert statistics.single_run


def test_seeds_are_resampled_within_each_task(make_records: Callable) -> None:
    # Task a: .2 with both seeds. Task b: .4 and .8. Draws of the mean: (.2 + {.4, .6, .8}) / 2.
    records = make_records("wm_bc", {"a": (10, 0), "b": (10, 10)}, seed=0)
    records += make_records("wm_bc", {"a": (0, 10), "b": (10, 30)}, seed=1)
    statistics = run_statistics(records)
    assert statistics.mean.percent == pytest.approx(40)
    assert statistics.mean.interval == pytest.approx((30, 50))
    assert not statistics.single_run


def test_the_one_run_of_a_task_is_resampled_by_variation(make_records: Callable) -> None:
    records = make_records("wm_bc", {"a": (10, 10), "b": (5, 20)}, seed=0)
    records += make_records("wm_bc", {"a": (10, 10)}, seed=1)
    statistics = run_statistics(records)
    low, high = statistics.mean.interval
    assert statistics.single_run
    assert low < statistics.mean.percent < high, "task b's variations must give the interval its width"


def test_the_same_records_give_the_same_interval(make_records: Callable) -> None:
    records = make_records("wm_bc", {"a": (5, 20), "b": (5, 30)})
    assert run_statistics(records) == run_statistics(records)
    assert str(run_statistics(make_records("wm_bc", {"a": (10, 40)})).mean) == "100 [100, 100]"
