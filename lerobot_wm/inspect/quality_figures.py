"""Figures of world-model quality, drawn from the content of quality.json; the examples from images in memory."""

from textwrap import fill
from typing import Any

import numpy as np
import pandas as pd
from matplotlib.figure import Figure
from torch import Tensor

from lerobot_wm.inspect.open_loop import HORIZONS
from lerobot_wm.inspect.pictures import draw_pictures, log_scale, tidy

EXAMPLES_NAME = "quality_examples.png"
EXAMPLE_HORIZON = 20
# Colour-blind safe (Okabe and Ito 2008); the model itself in the page's blue.
_COLOURS = ("#2f6fde", "#d55e00", "#7a7a7a", "#b8b8b8", "#009e73")
_LABELS = {"foreground_psnr": "foreground PSNR (dB)", "psnr": "PSNR (dB)", "ssim": "SSIM"}


def quality_figures(result: dict[str, Any]) -> dict[str, Figure]:
    """The figures of a quality.json by name."""
    probes = pd.DataFrame(result["probes"])
    return {
        "open_loop": _open_loop_figure(pd.DataFrame(result["open_loop"])),
        **({} if probes.empty else {"probes": _probes_figure(probes)}),
        "kl": _kl_figure(result["kl"]),
        "drift": _drift_figure(pd.DataFrame(result["drift"]), result["settings"]["restart"]),
    }


def examples_figure(images: dict[str, Tensor], tasks: list[str]) -> Figure:
    """One row per task: the last frame seen, the truth EXAMPLE_HORIZON steps later, and the predictions of it.

    Args:
        images: As `quality_measures.predictions` returns them, each (E, H, C, h, w).
        tasks: The task of each of the E episodes; the first of each is shown.
    """
    columns = ("copy last frame", "truth", "closed loop", "open loop", "shuffled actions")
    names = list(dict.fromkeys(tasks))
    height, width = images["truth"].shape[-2:]
    figsize = (1.5 * width / height * (len(columns) + 0.8), 1.6 * len(names))
    figure = Figure(figsize=figsize, layout="constrained")
    axes = figure.subplots(len(names), len(columns), squeeze=False)
    place = HORIZONS.index(EXAMPLE_HORIZON)

    def pictures(episode: int) -> list[np.ndarray]:
        return [images[column][episode, place].movedim(0, -1).numpy() for column in columns]

    draw_pictures(axes, [(task, pictures(tasks.index(task))) for task in names])
    for axis, column in zip(axes[0], columns, strict=True):
        axis.set_title("last seen" if column == "copy last frame" else column, fontsize=9)
    return figure


def _open_loop_figure(table: pd.DataFrame) -> Figure:
    """Error against horizon over all tasks, which come last in the table; one line per prediction."""
    figure = Figure(figsize=(9, 2.8), layout="constrained")
    overall = table[table["task"] == table["task"].iloc[-1]]
    for axes, (column, label) in zip(figure.subplots(1, 3), _LABELS.items(), strict=True):
        for colour, (prediction, group) in zip(
            _COLOURS, overall.groupby("prediction", sort=False), strict=True
        ):
            style = {"color": colour, "markersize": 3, "linewidth": 1.2, "label": prediction}
            axes.plot(group["horizon"], group[column], "o-", **style)
        axes.set_xlabel("steps ahead", fontsize=8)
        tidy(axes, label)
    figure.legend(*axes.get_legend_handles_labels(), loc="outside lower center", ncols=5, fontsize=8)
    return figure


def _probes_figure(table: pd.DataFrame) -> Figure:
    """Median error per task, one panel per target and one mark per representation."""
    targets = list(table["target"].unique())
    tasks = list(table["task"].unique())
    figure = Figure(figsize=(9, 0.3 * len(tasks) + 1.3), layout="constrained")
    panels = figure.subplots(1, len(targets), sharey=True, squeeze=False)[0]
    error, unit = probe_error(table)
    for axes, target in zip(panels, targets, strict=True):
        of_target = table[table["target"] == target]
        for colour, (name, group) in zip(
            _COLOURS, of_target.groupby("representation", sort=False), strict=True
        ):
            rows = [tasks.index(task) for task in group["task"]]
            axes.scatter(group[f"median_{error}"], rows, s=22, color=colour, label=name)
        axes.set_xlim(left=0)
        axes.set_xlabel(f"median error ({unit})", fontsize=8)
        axes.set_yticks(range(len(tasks)), [fill(task, 30) for task in tasks])
        tidy(axes, target)
    panels[0].invert_yaxis()
    figure.legend(*panels[0].get_legend_handles_labels(), loc="outside lower center", ncols=5, fontsize=8)
    return figure


def probe_error(table: pd.DataFrame) -> tuple[str, str]:
    """How the columns of the probes' errors end, and their unit."""
    return ("cm", "cm") if "median_cm" in table.columns else ("std", "standard deviations")


def _kl_figure(kl: dict[str, Any]) -> Figure:
    figure = Figure(figsize=(4.4, 2.6), layout="constrained")
    axes = figure.subplots()
    axes.stairs(kl["histogram"]["counts"], kl["histogram"]["edges"], fill=True, color=_COLOURS[0], alpha=0.6)
    axes.axvline(kl["free_nats"], color=_COLOURS[1], linewidth=1.2, label="free nats")
    axes.set_xlabel("KL(posterior || prior) per step (nats)", fontsize=8)
    axes.legend(fontsize=8)
    tidy(axes, "steps")
    return figure


def _drift_figure(table: pd.DataFrame, restart: int) -> Figure:
    figure = Figure(figsize=(9, 2.8), layout="constrained")
    left, right = figure.subplots(1, 2)
    left.plot(table["step"], table["psnr"], color=_COLOURS[0], linewidth=1.2, label="from the first frame on")
    # Dashes leave both visible where they are equal.
    style = {"color": _COLOURS[1], "linewidth": 1.2, "label": f"restarted {restart - 1} steps before"}
    left.plot(table["step"], table["restarted_psnr"], "--", **style)
    right.plot(table["step"], table["kl"], color=_COLOURS[0], linewidth=1.2)
    log_scale(right)
    for axes, label in ((left, "reconstruction PSNR (dB)"), (right, "KL per step (nats)")):
        axes.axvline(restart, color="#7a7a7a", linewidth=0.8, linestyle="--")
        axes.set_xlabel("step of the episode", fontsize=8)
        tidy(axes, label)
    left.legend(fontsize=8)
    return figure
