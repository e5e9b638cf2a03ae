"""The tables' renderings and width."""

import io
from collections.abc import Callable

from rich.console import Console

from lerobot_wm.records import SuccessRate
from lerobot_wm.report.arms import ARMS
from lerobot_wm.report.success import comparison_tables, overall_table, paper_comparison, task_table
from lerobot_wm.tables import ReportTable, markdown_table, table_by_split, terminal_tables

TASKS = {"button-press-topdown-v3": (10, 39), "reach-v3": (4, 15)}
SIX = {
    "button-press-topdown-v3": (10, 40),
    "door-open-v3": (10, 40),
    "drawer-open-v3": (10, 40),
    "reach-v3": (10, 40),
    "window-close-v3": (10, 40),
    "window-open-v3": (10, 40),
}


def printed(table: ReportTable) -> list[str]:
    output = io.StringIO()
    Console(file=output, width=100).print(*terminal_tables(table))
    return output.getvalue().splitlines()


def test_by_split(make_records: Callable) -> None:
    table = table_by_split("wm_bc", make_records("wm_bc", TASKS))
    assert table.columns == ["seen", "unseen", "all"]
    assert table.rows == [
        ("button-press-topdown-v3", [SuccessRate(10, 10), SuccessRate(39, 40), SuccessRate(49, 50)]),
        ("reach-v3", [SuccessRate(4, 10), SuccessRate(15, 40), SuccessRate(19, 50)]),
        ("all tasks", [SuccessRate(14, 20), SuccessRate(54, 80), SuccessRate(68, 100)]),
    ]
    assert table.n_totals == 1
    assert any("15/40  38 [24, 53]" in line for line in printed(table)), "in full where it fits"


def test_environments_without_variations_have_one_column(make_records: Callable) -> None:
    records = [record | {"seen": None} for record in make_records("act", TASKS)]
    assert table_by_split("act", records).columns == ["all"]


def test_markdown(make_records: Callable) -> None:
    table = task_table("Success per task", make_records("wm_bc", {"reach-v3": (4, 15)}))
    lines = markdown_table(table).splitlines()
    assert lines[:5] == [
        "## Success per task",
        "",
        "| arm | reach-v3 |",
        "|---|---:|",
        "| wm_bc | 19/50  38 [26, 52] |",
    ]
    first_note = lines[6 : lines.index("", 6)]
    assert " ".join(first_note) == table.notes[0]
    assert max(map(len, first_note)) <= 120


def test_what_is_missing_is_a_dash() -> None:
    table = ReportTable("t", "arm", ["reach-v3"], [("wm_bc", [None])])
    assert "| wm_bc | – |" in markdown_table(table)


def test_every_arm_fits_100_columns(make_records: Callable) -> None:
    """Nothing is wrapped or cut at the widest: all arms, 150 of 150 in every cell."""
    records = [r for arm in ARMS for seed in range(3) for r in make_records(arm, SIX, seed)]
    tables = [task_table("", records), overall_table(records), paper_comparison(records)]
    for table in tables + comparison_tables(records)[:1]:
        lines = printed(table)
        assert max(map(len, lines)) <= 100
        for label, _ in table.rows:
            assert any(line.startswith(f"{label} ") for line in lines), label
    assert sum(line.count("100 98–100") for line in printed(tables[0])) == 6 * len(ARMS)


def test_ten_tasks_are_cut_into_two_tables(make_records: Callable) -> None:
    records = make_records("wm_bc", {f"task-{i}-v3": (10, 40) for i in range(10)})
    text = "\n".join(printed(task_table("Success per task", records)))
    assert text.count("Success per task") == 2
    assert text.count("100 93–100") == 10
