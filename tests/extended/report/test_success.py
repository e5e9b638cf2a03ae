"""The tables by arm: order, contents, the paper's numbers, and what their notes say."""

from collections.abc import Callable

import pytest

from lerobot_wm.constants import MT6
from lerobot_wm.envs.tasks import all_tasks, tasks_by_tier
from lerobot_wm.records import Estimate, SuccessRate
from lerobot_wm.report.arms import ARMS
from lerobot_wm.report.comparison import group_by_arm
from lerobot_wm.report.success import (
    PAPER_TABLE,
    comparison_tables,
    overall_table,
    paper_comparison,
    seed_table,
    task_table,
    tier_table,
)

TASKS = {"button-press-topdown-v3": (10, 39), "reach-v3": (4, 15)}
SIX = dict.fromkeys(MT6, (9, 30))


def test_arms_down_in_a_fixed_order_tasks_across(make_records: Callable) -> None:
    records = [r for arm in ("mine", "proprio_bc", "wm_bc", "e2e_bc") for r in make_records(arm, TASKS)]
    table = task_table("Success per task", records + make_records("wm_iql", {"reach-v3": (5, 20)}))
    assert table.columns == list(TASKS)
    assert [arm for arm, _ in table.rows] == ["e2e_bc", "wm_iql", "wm_bc", "proprio_bc", "mine"]
    assert dict(table.rows)["wm_iql"] == [None, SuccessRate(25, 50)]
    assert dict(table.rows)["wm_bc"] == [SuccessRate(49, 50), SuccessRate(19, 50)]


def test_many_tasks_go_down(make_records: Callable) -> None:
    records = make_records("wm_bc", dict.fromkeys(all_tasks(), (4, 15)))
    table = task_table("Success per task", records)
    assert (table.corner, table.columns) == ("task", ["wm_bc"])
    assert dict(table.rows) == dict.fromkeys(all_tasks(), (SuccessRate(19, 50),))


def test_the_mean_of_tiers_counts_each_tier_once(make_records: Callable) -> None:
    """28 easy tasks weigh as much as the 5 very hard ones; single rollouts are resampled within their task."""
    solved = dict.fromkeys(all_tasks(), (10, 40)) | dict.fromkeys(tasks_by_tier()["very hard"], (0, 25))
    records = make_records("wm_bc", solved) + make_records("wm_iql", {"reach-v3": (1, 1)})
    table = tier_table(records)
    assert table is not None
    assert table.columns[-2:] == ["very hard (5 tasks)", "mean of tiers"]
    *tiers, mean = dict(table.rows)["wm_bc"]
    assert [tier.percent for tier in tiers] == [100, 100, 100, 50]
    assert mean.percent == pytest.approx(87.5)
    # 250 rollouts at one half have a deviation of 3.16 points, of which the mean takes a quarter.
    assert mean.interval == pytest.approx((87.5 - 1.55, 87.5 + 1.55), abs=0.2)
    assert dict(table.rows)["wm_iql"][-1] is None, "it lacks tasks"
    assert tier_table(make_records("wm_bc", SIX)) is None


def test_unknown_arms_keep_their_order(make_records: Callable) -> None:
    arms = [f"mine {i}" for i in range(9)]
    assert list(group_by_arm(r for arm in arms for r in make_records(arm, TASKS))) == arms


def test_seeds_are_pooled_and_counted(make_records: Callable) -> None:
    records = make_records("wm_bc", TASKS, seed=0) + make_records("wm_bc", {"reach-v3": (5, 20)}, seed=1)
    assert dict(task_table("", records).rows)["wm_bc"][1] == SuccessRate(44, 100)
    table = overall_table(records)
    assert table.columns == ["seeds", "seen", "unseen", "all", "mean", "IQM"]
    seeds, seen, unseen, together, mean, iqm = dict(table.rows)["wm_bc"]
    assert (seeds, seen, unseen) == (2, SuccessRate(19, 30), SuccessRate(74, 120))
    assert together == SuccessRate(93, 150)
    assert isinstance(mean, Estimate)
    assert mean.percent == pytest.approx(100 * (0.98 + 0.38 + 0.5) / 3)
    assert iqm.percent == pytest.approx(mean.percent), "a quarter of three scores is none"

    by_seed = seed_table(records)
    assert dict(by_seed.rows) == {
        "wm_bc, seed 0": [SuccessRate(49, 50), SuccessRate(19, 50), SuccessRate(68, 100)],
        "wm_bc, seed 1": [None, SuccessRate(25, 50), SuccessRate(25, 50)],
    }


def test_environments_without_variations_have_no_splits(make_records: Callable) -> None:
    records = [record | {"seen": None} for record in make_records("act", TASKS)]
    assert overall_table(records).columns == ["seeds", "all", "mean", "IQM"]


def test_notes_say_what_was_resampled_and_trained_on(make_records: Callable) -> None:
    def notes(*arms: str, seeds: int = 1) -> str:
        return "\n".join(
            overall_table([r for a in arms for s in range(seeds) for r in make_records(a, TASKS, s)]).notes
        )

    assert "(wm_bc)" in notes("wm_bc"), "its variations are resampled"
    assert "80%" not in notes("wm_bc")
    assert "(wm_bc)" not in notes("wm_bc", seeds=2)
    assert "80%" in notes("wm_bc", seeds=2), "how wide the interval over seeds is"
    assert "0.61" not in notes("wm_bc")
    assert "[0.61, 1.65]" in notes("wm_iql"), "the weights at β 0.5"
    assert "e2e_iql_dense" in notes("e2e_iql", "e2e_iql_dense")
    assert "dense" not in notes("e2e_iql")


def test_the_papers_numbers() -> None:
    # What Table 1 prints last; Individual BC is the one row that its own cells do not give.
    for arm, paper in PAPER_TABLE.items():
        mean = paper.all_tasks().successes / paper.all_tasks().n
        assert mean == pytest.approx(0.57 if arm == "e2e_bc_single" else paper.overall, abs=1e-4)
        assert [cell.successes / cell.n for cell in paper.cells()] == pytest.approx(paper.rates)
    assert PAPER_TABLE.keys() <= ARMS.keys()
    assert [round(b) for b in PAPER_TABLE["wm_iql"].all_tasks().interval] == [59, 70]


def test_ours_beside_the_papers(make_records: Callable) -> None:
    records = make_records("wm_bc", SIX) + make_records("e2e_iql_dense", SIX) + make_records("state_bc", SIX)
    table = paper_comparison(records)
    labels = [label for label, _ in table.rows]
    assert labels[:4] == ["e2e_iql", "e2e_iql_dense", "  paper's e2e_iql", "e2e_bc"]
    assert labels[-2:] == ["wm_bc", "  paper's wm_bc"]
    assert "state_bc" not in labels
    rows = dict(table.rows)
    assert rows["wm_bc"] == [SuccessRate(39, 50)] * 6 + [SuccessRate(234, 300), None]
    assert rows["  paper's wm_bc"][3] == SuccessRate(10, 50), "reach"
    assert rows["  paper's wm_bc"][-2:] == [SuccessRate(197, 300), "0.6567"]
    assert rows["e2e_iql"] == [None] * 8, "not run: said so"


def test_the_paper_is_not_put_beside_other_tasks(make_records: Callable) -> None:
    assert paper_comparison(make_records("wm_bc", TASKS)) is None
    assert paper_comparison(make_records("wm_bc", SIX | {"push-v3": (0, 0)})) is None


def test_comparison_in_words(make_records: Callable) -> None:
    records = make_records("wm_bc", {"reach-v3": (10, 8)}) + make_records("proprio_bc", {"reach-v3": (5, 5)})
    [table] = comparison_tables(records)
    assert "wm_bc" in table.title
    [(other, cells)] = table.rows
    assert other == "proprio_bc"
    assert cells[0].startswith("+16.0 [+")
    assert cells[1:-1] == [None, "8–0", "0.008", 50]
    assert cells[-1].startswith("better")
    assert comparison_tables(make_records("proprio_bc", TASKS)) == []


def test_comparisons_over_seeds_have_no_p(make_records: Callable) -> None:
    records = [r for arm in ("wm_iql", "wm_bc") for seed in (0, 1) for r in make_records(arm, TASKS, seed)]
    tables = comparison_tables(records)
    assert [table.rows[0][1][1] for table in tables] == ["[+0.0, +0.0]"] * 2
    assert [table.rows[0][1][3] for table in tables] == [None, None]
    assert [bool(table.notes) for table in tables] == [False, True], "explained once"
