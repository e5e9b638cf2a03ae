"""The tables' content and width."""

import io
from collections.abc import Callable

from rich.console import Console

from lerobot_wm.report.statistics import SuccessRate
from lerobot_wm.report.tables import markdown_table, table_by_run, table_by_split, terminal_tables

TASKS = {"button-press-topdown-v3": (10, 39), "reach-v3": (4, 15)}


def test_runs_across_tasks_down_totals_last(make_records: Callable) -> None:
    records = make_records("wm_bc", TASKS) + make_records("wm_iql", {"reach-v3": (5, 20)})
    table = table_by_run(records)
    assert table.columns == ["wm_bc", "wm_iql"]
    assert table.rows == {
        "button-press-topdown-v3": [SuccessRate(49, 50), None],
        "reach-v3": [SuccessRate(19, 50), SuccessRate(25, 50)],
        "all tasks, seen": [SuccessRate(14, 20), SuccessRate(5, 10)],
        "all tasks, unseen": [SuccessRate(54, 80), SuccessRate(20, 40)],
        "all tasks": [SuccessRate(68, 100), SuccessRate(25, 50)],
    }
    assert table.n_totals == 3


def test_training_seeds_are_columns_of_their_own(make_records: Callable) -> None:
    records = make_records("wm_bc", TASKS, seed=0) + make_records("wm_bc", TASKS, seed=1)
    assert table_by_run(records + make_records("blind", TASKS)).columns == [
        "wm_bc seed 0",
        "wm_bc seed 1",
        "blind",
    ]


def test_by_split(make_records: Callable) -> None:
    table = table_by_split("wm_bc", make_records("wm_bc", TASKS))
    assert table.columns == ["seen", "unseen", "all"]
    assert table.rows["reach-v3"] == [SuccessRate(4, 10), SuccessRate(15, 40), SuccessRate(19, 50)]
    assert table.rows["all tasks"] == [SuccessRate(14, 20), SuccessRate(54, 80), SuccessRate(68, 100)]


def test_environments_without_variations_have_no_splits(make_records: Callable) -> None:
    records = [record | {"seen": None} for record in make_records("act", TASKS)]
    assert table_by_split("act", records).columns == ["all"]
    assert list(table_by_run(records).rows) == [*TASKS, "all tasks"]


def test_markdown(make_records: Callable) -> None:
    lines = markdown_table(table_by_run(make_records("wm_bc", {"reach-v3": (4, 15)}))).splitlines()
    assert lines[:3] == ["| task | wm_bc |", "|---|---:|", "| reach-v3 | 19/50  38 [26, 52] |"]


def test_terminal_tables_fit_100_columns(make_records: Callable) -> None:
    records = [r for i in range(7) for r in make_records(f"frozen_bc_{i}", TASKS)]
    output = io.StringIO()
    Console(file=output, width=100).print(*terminal_tables(table_by_run(records)))
    lines = output.getvalue().splitlines()
    assert max(map(len, lines)) <= 100
    # Nothing is wrapped or cut: each of the 7 runs shows its cell in full.
    assert sum(line.count("49/50  98 [90, 100]") for line in lines) == 7
