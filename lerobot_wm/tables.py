"""The report's tables: one data structure for the terminal, for markdown and for the page's template."""

from collections.abc import Iterable
from dataclasses import dataclass, field
from itertools import batched

from rich.console import RenderableType
from rich.table import Table
from rich.text import Text

from lerobot_wm.records import Record, by_task
from lerobot_wm.statistics import SPLITS, Estimate, SuccessRate, in_split, success_rate

# What a terminal of 100 columns holds beside the longest label.
FULL_COLUMNS, COMPACT_COLUMNS = 3, 6
SEEN = "Seen variations are those that demonstrations are collected on by default, 0-9 of set 42."
WILSON = "Successes/rollouts, per cent, [Wilson 95% interval over rollouts]."

Cell = SuccessRate | Estimate | str | int | None


@dataclass(frozen=True)
class ReportTable:
    """Labelled rows of cells; a cell is None where there is nothing to show."""

    title: str
    corner: str  # what the row labels are
    columns: list[str]
    rows: list[tuple[str, list[Cell]]]
    n_totals: int = 0  # how many of the last rows are over all tasks
    notes: list[str] = field(default_factory=list)


def table_by_split(title: str, records: list[Record]) -> ReportTable:
    """One arm's records: tasks down; seen, unseen and all variations across."""

    def cells(chosen: list[Record]) -> list[Cell]:
        return [success_rate(r for r in chosen if in_split(r, split)) for split in splits]

    splits = present_splits(records)
    rows = [(task, cells(of_task)) for task, of_task in by_task(records).items()]
    rows.append(("all tasks", cells(records)))
    notes = [WILSON, SEEN] if "seen" in splits else [WILSON]
    return ReportTable(title, "task", list(splits), rows, n_totals=1, notes=notes)


def present_splits(records: Iterable[Record]) -> tuple[str, ...]:
    """The splits that have records: "seen" and "unseen" only where the environment knows them."""
    known = {record["seen"] for record in records}
    return tuple(s for s in SPLITS if s == "all" or (s == "seen") in known)


def terminal_tables(table: ReportTable) -> list[RenderableType]:
    """The table for rich's console in at most 100 characters, then its notes.

    With more than three columns rates lose their counts ("88 76–94"); with more than six the table is cut.
    """
    compact = len(table.columns) > FULL_COLUMNS
    shown: list[RenderableType] = []
    for chosen in batched(range(len(table.columns)), COMPACT_COLUMNS):
        part = Table(title=table.title, title_justify="left", box=None, padding=(0, 1), pad_edge=False)
        part.add_column(table.corner, no_wrap=True)
        for index in chosen:
            part.add_column(table.columns[index].removesuffix("-v3").replace("-", "\n"), justify="right")
        for number, (label, cells) in enumerate(table.rows, start=1):
            texts = [_compact(cells[index]) if compact else cell_text(cells[index]) for index in chosen]
            part.add_row(label, *texts, end_section=number == len(table.rows) - table.n_totals)
        shown.append(part)
    shown.append(Text("\n".join([*table.notes, ""]), style="dim"))
    return shown


def markdown_table(table: ReportTable) -> str:
    """The table as GitHub markdown under a heading, its notes below."""
    lines = [f"## {table.title}", "", f"| {table.corner} | {' | '.join(table.columns)} |"]
    lines.append("|---|" + "---:|" * len(table.columns))
    lines += [f"| {label} | {' | '.join(map(cell_text, cells))} |" for label, cells in table.rows]
    return "\n".join(lines) + "\n\n" + "".join(f"{note}\n\n" for note in table.notes)


def cell_text(cell: Cell) -> str:
    """A cell in full."""
    return "–" if cell is None else str(cell)


def _compact(cell: Cell) -> str:
    if isinstance(cell, SuccessRate | Estimate):
        low, high = cell.interval
        return f"{cell.percent:.0f} [dim]{low:.0f}–{high:.0f}[/dim]"
    return cell_text(cell)
