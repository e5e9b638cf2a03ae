"""Tables of results: one data structure for the terminal, for Markdown and for the report's page."""

import textwrap
from collections.abc import Sequence
from dataclasses import dataclass, field, replace
from itertools import batched

from rich.console import RenderableType
from rich.table import Table
from rich.text import Text

from lerobot_wm.records import (
    Estimate,
    Record,
    SuccessRate,
    group_by_task,
    is_in_split,
    present_splits,
    success_rate,
)

# What a terminal of 100 columns holds beside the longest label.
FULL_COLUMNS, COMPACT_COLUMNS = 3, 6
SEEN = "Demonstrations are collected on the seen variations, by default 0-9 of set 42."
WILSON = "Successes/rollouts, success in percent, [Wilson 95% interval over rollouts]."


@dataclass(frozen=True)
class Measurement:
    """A number, and beside it in small print what belongs to it."""

    text: str
    small: str

    def __str__(self) -> str:
        return f"{self.text} ({self.small})"


Cell = SuccessRate | Estimate | Measurement | str | int | None


@dataclass(frozen=True)
class ReportTable:
    """Labelled rows of cells.

    Attributes:
        title: The table's heading.
        corner: What the row labels are.
        columns: What the columns are.
        rows: Each row's label and cells; None where there is nothing to show.
        n_totals: How many of the last rows summarise all tasks.
        notes: Paragraphs to show below the table.
    """

    title: str
    corner: str
    columns: list[str]
    rows: Sequence[tuple[str, Sequence[Cell]]]
    n_totals: int = 0
    notes: list[str] = field(default_factory=list)

    def transposed(self, corner: str) -> "ReportTable":
        """Rows as columns, with another corner."""
        labels, cells = zip(*self.rows, strict=True)
        rows = list(zip(self.columns, zip(*cells, strict=True), strict=True))
        return replace(self, corner=corner, columns=list(labels), rows=rows)


def table_by_split(title: str, records: list[Record]) -> ReportTable:
    """One arm's records: tasks down; seen, unseen and all variations across."""
    splits = present_splits(records)

    def rates(chosen: list[Record]) -> list[SuccessRate | None]:
        return [success_rate(r for r in chosen if is_in_split(r, split)) for split in splits]

    rows = [(task, rates(of_task)) for task, of_task in group_by_task(records).items()]
    rows.append(("all tasks", rates(records)))
    notes = [WILSON, SEEN] if "seen" in splits else [WILSON]
    return ReportTable(title, "task", list(splits), rows, n_totals=1, notes=notes)


def terminal_tables(table: ReportTable) -> list[RenderableType]:
    """The table for rich's console in at most 100 characters, then its notes.

    With more than three columns rates lose their counts ("88 76–94"); with more than six the table is split.
    """
    compact = len(table.columns) > FULL_COLUMNS
    shown: list[RenderableType] = []
    for chosen in batched(range(len(table.columns)), COMPACT_COLUMNS):
        part = Table(title=table.title, title_justify="left", box=None, padding=(0, 1), pad_edge=False)
        part.add_column(table.corner, no_wrap=True)
        for index in chosen:
            part.add_column(table.columns[index].removesuffix("-v3").replace("-", "\n"), justify="right")
        for number, (label, cells) in enumerate(table.rows, start=1):
            texts = [_compact_text(cells[index]) if compact else cell_text(cells[index]) for index in chosen]
            part.add_row(label, *texts, end_section=number == len(table.rows) - table.n_totals)
        shown.append(part)
    shown.append(Text("\n".join([*table.notes, ""]), style="dim"))
    return shown


def markdown_table(table: ReportTable) -> str:
    """The table as GitHub Markdown under a heading, its notes below."""
    lines = [f"## {table.title}", "", f"| {table.corner} | {' | '.join(table.columns)} |"]
    lines.append("|---|" + "---:|" * len(table.columns))
    lines += [f"| {label} | {' | '.join(map(cell_text, cells))} |" for label, cells in table.rows]
    notes = (textwrap.fill(note, 120, break_long_words=False, break_on_hyphens=False) for note in table.notes)
    return "\n".join(lines) + "\n\n" + "".join(f"{note}\n\n" for note in notes)


def cell_text(cell: Cell) -> str:
    """A cell in full."""
    return "–" if cell is None else str(cell)


def _compact_text(cell: Cell) -> str:
    if isinstance(cell, SuccessRate | Estimate):
        low, high = cell.interval
        return f"{cell.percent:.0f} [dim]{low:.0f}–{high:.0f}[/dim]"
    return cell_text(cell)
