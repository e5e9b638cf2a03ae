"""Tables of rows and results, for the terminal and in Markdown."""

from collections.abc import Iterable, Mapping
from typing import Any

from rich.table import Table

from benchmarks.environments import OWN
from benchmarks.measure import Result
from benchmarks.rows import ROWS, Row, Size

WIDTH = 100


def number(value: float) -> str:
    """Format a value with three significant digits and without an exponent."""
    if value == 0:
        return "0"
    if abs(value) >= 100:
        return f"{value:,.0f}"
    return f"{value:#.3g}".rstrip(".")


def size_text(size: Size) -> str:
    """Format a size, such as `batch 16, length 25`."""
    return ", ".join(f"{name.replace('_', ' ')} {value:g}" for name, value in size.items())


def results_table(results: Iterable[Result]) -> Table:
    """Make a table of medians, ranges and ratios."""
    table = Table(width=WIDTH, title="Median, with the lowest and highest value below")
    for title in ("row", "size", "against"):
        table.add_column(title, overflow="fold")
    for title in ("ours", "peer", "times faster"):
        table.add_column(title, justify="right", overflow="fold")
    for result in results:
        peer, ratio = "", ""
        if result.peer is not None and result.ratio is not None:
            peer, ratio = _spread(result.peer, result.spread["peer"]), number(result.ratio)
        table.add_row(
            f"{result.row}\n{result.unit}",
            size_text(result.sizes),
            result.peer_name or "",
            _spread(result.ours, result.spread["ours"]),
            peer,
            ratio,
        )
    return table


def markdown_table(entries: Iterable[Mapping[str, Any]]) -> str:
    """Format the entries of a results file (`Result` as dicts), one line each, in the order of the rows."""
    titles = {row.name: row.title for row in ROWS}
    order = list(titles)
    lines = ["| row | size | against | ours | peer | times faster |", "|---|---|---|---:|---:|---:|"]
    # Entries of rows that no longer exist keep their name and come last.
    for entry in sorted(entries, key=lambda e: order.index(e["row"]) if e["row"] in titles else len(order)):
        title = f"{titles.get(entry['row'], entry['row'])}; {entry['unit']}"
        peer, ratio = "", ""
        if entry["ratio"] is not None:
            peer, ratio = _range(entry["peer"], entry["spread"]["peer"]), number(entry["ratio"])
        ours = _range(entry["ours"], entry["spread"]["ours"])
        cells = (title, size_text(entry["sizes"]), entry["peer_name"] or "", ours, peer, ratio)
        lines.append(f"| {' | '.join(cells)} |")
    return "\n".join(lines) + "\n"


def rows_table(rows: Iterable[Row], scale: float) -> Table:
    """Make a table of the rows, their sizes, and the environment each peer needs."""
    table = Table(width=WIDTH)
    for title in ("row", "what", "sizes", "against (needs)"):
        table.add_column(title, overflow="fold")
    for row in rows:
        table.add_row(
            row.name,
            f"{row.title}; {row.unit}",
            "\n".join(size_text(size) for size in row.scaled_sizes(scale)),
            "\n".join(f"{peer.name} ({_needs(peer.environment)})" for peer in row.peers) or "nobody",
        )
    return table


def _spread(median: float, ends: list[float]) -> str:
    return _range(median, ends).replace(" ", "\n", 1)


def _range(median: float, ends: list[float]) -> str:
    low, high = ends
    return f"{number(median)} [{number(low)}, {number(high)}]"


def _needs(environment: str) -> str:
    return "nothing more" if environment == OWN else f"the environment {environment}"
