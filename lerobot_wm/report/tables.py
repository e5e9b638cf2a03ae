"""Success tables: one data structure for the terminal, for markdown and for the page's template."""

from dataclasses import dataclass

from rich.table import Table

from lerobot_wm.report.records import Record
from lerobot_wm.report.statistics import SPLITS, SuccessRate, in_split, success_rate

# Three cells of "50/50  100 [93, 100]" beside the longest task name fit a terminal of 100 columns.
COLUMNS_PER_TERMINAL_TABLE = 3


@dataclass(frozen=True)
class SuccessTable:
    """Success rates by row and column; a cell is None where nothing was rolled out."""

    title: str
    columns: list[str]
    rows: dict[str, list[SuccessRate | None]]
    n_totals: int  # how many of the last rows are over all tasks


def runs(records: list[Record]) -> dict[str, list[Record]]:
    """Records by run (arm and training seed); the seed is named only where an arm has several."""
    seeds: dict[str, set[int | None]] = {}
    for record in records:
        seeds.setdefault(record["arm"], set()).add(record["seed"])
    by_run: dict[str, list[Record]] = {}
    for record in records:
        several = len(seeds[record["arm"]]) > 1
        name = f"{record['arm']} seed {record['seed']}" if several else record["arm"]
        by_run.setdefault(name, []).append(record)
    return by_run


def table_by_run(records: list[Record]) -> SuccessTable:
    """Tasks down, runs across; below them all tasks together: seen, unseen and all variations."""
    by_run = runs(records)
    rows = {task: [success_rate(_of_task(run, task)) for run in by_run.values()] for task in _tasks(records)}
    for split in _splits(records):
        name = "all tasks" if split == "all" else f"all tasks, {split}"
        rows[name] = [success_rate(r for r in run if in_split(r, split)) for run in by_run.values()]
    return SuccessTable("Success per task", list(by_run), rows, len(_splits(records)))


def table_by_split(title: str, records: list[Record]) -> SuccessTable:
    """One run's records: tasks down; seen, unseen and all variations across."""

    def cells(chosen: list[Record]) -> list[SuccessRate | None]:
        return [success_rate(r for r in chosen if in_split(r, split)) for split in splits]

    splits = _splits(records)
    rows = {task: cells(_of_task(records, task)) for task in _tasks(records)}
    return SuccessTable(title, list(splits), rows | {"all tasks": cells(records)}, n_totals=1)


def terminal_tables(table: SuccessTable) -> list[Table]:
    """The table for rich's console, cut into groups of columns that fit 100 characters."""
    tables = []
    for start in range(0, len(table.columns), COLUMNS_PER_TERMINAL_TABLE):
        chosen = slice(start, start + COLUMNS_PER_TERMINAL_TABLE)
        shown = Table(title=table.title, caption="successes/rollouts  % [Wilson 95%]")
        shown.add_column("task")
        for column in table.columns[chosen]:
            shown.add_column(column, justify="right")
        for index, (name, cells) in enumerate(table.rows.items(), start=1):
            last_of_section = index == len(table.rows) - table.n_totals
            shown.add_row(name, *_texts(cells[chosen]), end_section=last_of_section)
        tables.append(shown)
    return tables


def markdown_table(table: SuccessTable) -> str:
    """The table as GitHub markdown."""
    lines = ["| task | " + " | ".join(table.columns) + " |", "|---|" + "---:|" * len(table.columns)]
    lines += [f"| {name} | " + " | ".join(_texts(cells)) + " |" for name, cells in table.rows.items()]
    return "\n".join(lines) + "\n"


def _texts(cells: list[SuccessRate | None]) -> list[str]:
    return ["–" if cell is None else str(cell) for cell in cells]


def _tasks(records: list[Record]) -> list[str]:
    return sorted({record["task"] for record in records})


def _of_task(records: list[Record], task: str) -> list[Record]:
    return [record for record in records if record["task"] == task]


def _splits(records: list[Record]) -> tuple[str, ...]:
    """The splits that have records: "seen" and "unseen" only where the environment knows them."""
    return tuple(split for split in SPLITS if any(in_split(record, split) for record in records))
