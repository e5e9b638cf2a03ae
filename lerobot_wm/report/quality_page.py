"""quality.json as a section of the report page."""

import json
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import pandas as pd

from lerobot_wm.report.inline import PNG, SVG, data_uri, figure_bytes
from lerobot_wm.report.quality_figures import EXAMPLE_HORIZON, EXAMPLES_NAME, quality_figures
from lerobot_wm.report.templates import template_environment

_ABSENT = "–"


@dataclass(frozen=True)
class Cell:
    """A number and, small beside it, what else belongs to it."""

    text: str
    small: str = ""


@dataclass(frozen=True)
class Table:
    """Rows by name, the last `n_totals` of them set off."""

    corner: str
    columns: list[str]
    rows: dict[str, list[Cell]]
    n_totals: int = 0


def quality_section(path: Path) -> str:
    """HTML of `<h3>World-model quality</h3>` and what follows, figures inlined; styled by the page's classes.

    Args:
        path: A quality.json of `lerobot-wm quality`, with the picture of examples beside it.

    Raises:
        FileNotFoundError: One of the two is missing.
    """
    examples = path.with_name(EXAMPLES_NAME)
    for needed in (path, examples):
        if not needed.is_file():
            raise FileNotFoundError(
                f"{needed} is missing: expected the quality.json of `lerobot-wm quality` in its output folder."
            )
    result = json.loads(path.read_text())
    environment = template_environment()
    return environment.get_template("quality_section.html.j2").render(
        result,
        figures={
            name: data_uri(figure_bytes(figure, SVG), SVG) for name, figure in quality_figures(result).items()
        },
        examples=data_uri(examples.read_bytes(), PNG),
        example_horizon=EXAMPLE_HORIZON,
        kl_overall=result["kl"]["tasks"][-1],
        open_loop_table=_open_loop_table(pd.DataFrame(result["open_loop"])),
        foreground_table=_foreground_table(pd.DataFrame(result["open_loop"])),
        reward_table=_reward_table(result["reward"]) if result["reward"] else None,
        probe_tables=_probe_tables(pd.DataFrame(result["probes"])),
        kl_table=_kl_table(result["kl"]["tasks"]),
    )


def _open_loop_table(table: pd.DataFrame) -> Table:
    """Predictions down, horizons across, over all tasks."""
    overall = table[table["task"] == table["task"].iloc[-1]]
    rows = {
        prediction: [
            Cell(_number(row.foreground_psnr, 1), f"{row.psnr:.1f} · {row.ssim:.2f}")
            for row in group.itertuples()
        ]
        for prediction, group in overall.groupby("prediction", sort=False)
    }
    return Table("prediction", [f"+{horizon}" for horizon in overall["horizon"].unique()], rows)


def _foreground_table(table: pd.DataFrame) -> Table:
    """Tasks down, predictions across: foreground PSNR at EXAMPLE_HORIZON."""
    chosen = table[table["horizon"] == EXAMPLE_HORIZON]
    rows = {
        task: [Cell(_number(value, 1)) for value in group["foreground_psnr"]]
        for task, group in chosen.groupby("task", sort=False)
    }
    return Table("task", list(chosen["prediction"].unique()), rows, n_totals=1)


def _reward_table(rows: list[dict[str, Any]]) -> Table:
    cells = {
        row["task"]: [
            Cell(f"{100 * row['base_rate']:.1f}%"),
            Cell(_number(row["average_precision"], 2)),
            Cell(_number(row["auroc"], 3)),
        ]
        for row in rows
    }
    return Table("task", ["base rate", "average precision", "AUROC"], cells, n_totals=1)


def _probe_tables(table: pd.DataFrame) -> dict[str, Table]:
    """One table per target: tasks down, representations across."""
    tables = {}
    for target, group in table.groupby("target", sort=False):
        rows = {
            task: [
                Cell(f"{row.median_cm:.1f}", f"{row.mean_cm:.1f} · {row.r2:.2f}")
                for row in of_task.itertuples()
            ]
            for task, of_task in group.groupby("task", sort=False)
        }
        tables[str(target)] = Table("task", list(group["representation"].unique()), rows, n_totals=1)
    return tables


def _kl_table(tasks: list[dict[str, Any]]) -> Table:
    names = list(tasks[0]["percentiles"])
    rows = {
        task["task"]: [
            Cell(f"{100 * task['share_under_free_nats']:.0f}%"),
            Cell(f"{task['mean']:.1f}"),
            *(Cell(f"{task['percentiles'][name]:.1f}") for name in names),
        ]
        for task in tasks
    }
    return Table("task", ["under free nats", "mean", *(f"{name}%" for name in names)], rows, n_totals=1)


def _number(value: float | None, digits: int) -> str:
    return _ABSENT if value is None or pd.isna(value) else f"{value:.{digits}f}"
