"""Figures of world-model quality, drawn from quality.json (and the example images from memory)."""

import json
from dataclasses import dataclass
from pathlib import Path
from textwrap import fill
from typing import Any

import pandas as pd
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from torch import Tensor

from lerobot_wm.inspect.html import PNG, SVG, data_uri, figure_bytes, template_environment

EXAMPLES_NAME = "quality_examples.png"
EXAMPLE_HORIZON = 20
# Colour-blind safe (Okabe and Ito 2008); the model itself in the page's blue.
_COLOURS = ("#2f6fde", "#d55e00", "#7a7a7a", "#b8b8b8", "#009e73")
_LABELS = {"foreground_psnr": "foreground PSNR (dB)", "psnr": "PSNR (dB)", "ssim": "SSIM"}


def quality_figures(result: dict[str, Any]) -> dict[str, Figure]:
    """The figures of a quality.json by name."""
    return {
        "open_loop": _open_loop_figure(pd.DataFrame(result["open_loop"])),
        "probes": _probes_figure(pd.DataFrame(result["probes"])),
        "kl": _kl_figure(result["kl"]),
        "drift": _drift_figure(pd.DataFrame(result["drift"]), result["settings"]["restart"]),
    }


def examples_figure(images: dict[str, Tensor], tasks: list[str], horizons: tuple[int, ...]) -> Figure:
    """One row per task: the last frame seen, the truth EXAMPLE_HORIZON steps on, and the predictions of it.

    Args:
        images: As `quality_open_loop.predictions` returns them, each (E, H, C, h, w).
        tasks: The task of each of the E episodes; the first of each is shown.
        horizons: The H horizons.
    """
    columns = ("copy last frame", "truth", "closed loop", "open loop", "shuffled actions")
    names = list(dict.fromkeys(tasks))
    height, width = images["truth"].shape[-2:]
    figsize = (1.5 * width / height * (len(columns) + 0.8), 1.6 * len(names))
    figure = Figure(figsize=figsize, layout="constrained")
    axes = figure.subplots(len(names), len(columns), squeeze=False)
    for row, task in zip(axes, names, strict=True):
        episode = tasks.index(task)
        row[0].set_ylabel(fill(task, 16), fontsize=8, rotation=0, ha="right", va="center")
        for axis, column in zip(row, columns, strict=True):
            image = images[column][episode, horizons.index(EXAMPLE_HORIZON)].movedim(0, -1)  # (h, w, C)
            axis.imshow(image.numpy(), interpolation="nearest")
            axis.set_xticks([])
            axis.set_yticks([])
    for axis, column in zip(axes[0], columns, strict=True):
        axis.set_title("last seen" if column == "copy last frame" else column, fontsize=9)
    return figure


def _open_loop_figure(table: pd.DataFrame) -> Figure:
    """Error against horizon over all tasks (the last of the table), one line per prediction."""
    figure = Figure(figsize=(9, 2.8), layout="constrained")
    overall = table[table["task"] == table["task"].iloc[-1]]
    for axes, (column, label) in zip(figure.subplots(1, 3), _LABELS.items(), strict=True):
        for colour, (prediction, group) in zip(
            _COLOURS, overall.groupby("prediction", sort=False), strict=True
        ):
            axes.plot(
                group["horizon"],
                group[column],
                "o-",
                color=colour,
                markersize=3,
                linewidth=1.2,
                label=prediction,
            )
        axes.set_xlabel("steps ahead", fontsize=8)
        _tidy(axes, label)
    figure.legend(*axes.get_legend_handles_labels(), loc="outside lower center", ncols=5, fontsize=8)
    return figure


def _probes_figure(table: pd.DataFrame) -> Figure:
    """Median error per task, one panel per target and one mark per representation."""
    targets = list(table["target"].unique())
    tasks = list(table["task"].unique())
    figure = Figure(figsize=(9, 0.3 * len(tasks) + 1.3), layout="constrained")
    panels = figure.subplots(1, len(targets), sharey=True)
    for axes, target in zip(panels, targets, strict=True):
        of_target = table[table["target"] == target]
        for colour, (name, group) in zip(
            _COLOURS, of_target.groupby("representation", sort=False), strict=True
        ):
            rows = [tasks.index(task) for task in group["task"]]
            axes.scatter(group["median_cm"], rows, s=22, color=colour, label=name)
        axes.set_xlim(left=0)
        axes.set_xlabel("median error (cm)", fontsize=8)
        axes.set_yticks(range(len(tasks)), [fill(task, 30) for task in tasks])
        _tidy(axes, target)
    panels[0].invert_yaxis()
    figure.legend(*panels[0].get_legend_handles_labels(), loc="outside lower center", ncols=5, fontsize=8)
    return figure


def _kl_figure(kl: dict[str, Any]) -> Figure:
    figure = Figure(figsize=(4.4, 2.6), layout="constrained")
    axes = figure.subplots()
    axes.stairs(kl["histogram"]["counts"], kl["histogram"]["edges"], fill=True, color=_COLOURS[0], alpha=0.6)
    axes.axvline(kl["free_nats"], color=_COLOURS[1], linewidth=1.2, label="free nats")
    axes.set_xlabel("KL(posterior || prior) per step (nats)", fontsize=8)
    axes.legend(fontsize=8)
    _tidy(axes, "steps")
    return figure


def _drift_figure(table: pd.DataFrame, restart: int) -> Figure:
    figure = Figure(figsize=(9, 2.8), layout="constrained")
    left, right = figure.subplots(1, 2)
    left.plot(table["step"], table["psnr"], color=_COLOURS[0], linewidth=1.2, label="from the first frame on")
    left.plot(
        table["step"],
        table["restarted_psnr"],
        "--",  # it hides nothing where both are equal
        color=_COLOURS[1],
        linewidth=1.2,
        label=f"restarted {restart - 1} steps before",
    )
    right.plot(table["step"], table["kl"], color=_COLOURS[0], linewidth=1.2)
    right.set_yscale("log")
    for axes, label in ((left, "reconstruction PSNR (dB)"), (right, "KL per step (nats)")):
        axes.axvline(restart, color="#7a7a7a", linewidth=0.8, linestyle="--")
        axes.set_xlabel("step of the episode", fontsize=8)
        _tidy(axes, label)
    left.legend(fontsize=8)
    return figure


def _tidy(axes: Axes, title: str) -> None:
    axes.set_title(title, fontsize=10)
    axes.tick_params(labelsize=8)
    axes.grid(alpha=0.3)


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
