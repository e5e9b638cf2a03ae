"""Training curves from the `train_log.jsonl` of runs."""

import json
import os
from pathlib import Path

from matplotlib import colormaps
from matplotlib.figure import Figure

from lerobot_wm.constants import TRAIN_LOG_NAME
from lerobot_wm.inspect.html import short

# LeRobot's counters and timings, which say nothing about learning.
BOOKKEEPING = {
    "steps",
    "samples",
    "episodes",
    "epochs",
    "update_s",
    "dataloading_s",
    "samples_per_s",
    "gpu_mem_gb",
}
# One run as {name: [(step, value), ...]}.
Curves = dict[str, list[tuple[int, float]]]
COLOURS = colormaps["tab20"].colors  # type: ignore[attr-defined]  # a ListedColormap
LEGEND_COLUMNS = 2


def read_logs(runs: list[Path]) -> dict[str, Curves]:
    """The curves of runs, each named by its folder below the one that holds them all.

    Raises:
        FileNotFoundError: a folder holds no log.
    """
    if not runs:
        return {}
    common = os.path.commonpath([run.absolute().parent for run in runs])
    return {os.path.relpath(run, common): read_curves(run) for run in runs}


def read_curves(run: Path) -> Curves:
    """The losses and other measures a run logged by name, against the step.

    Raises:
        FileNotFoundError: the folder holds no log.
    """
    path = run / TRAIN_LOG_NAME
    if not path.exists():
        raise FileNotFoundError(
            f"{path} is missing: --train_logs takes output folders of `lerobot-wm train`."
        )
    curves: Curves = {}
    for line in path.read_text().splitlines():
        entry = json.loads(line)
        step = entry.pop("step")
        for name in entry.keys() - BOOKKEEPING:
            curves.setdefault(name, []).append((step, entry[name]))
    # A run that was stopped and went on from a checkpoint logs some steps again: what it logged last counts.
    return {name: sorted(dict(points).items()) for name, points in curves.items()}


def curve_figures(runs: dict[str, Curves]) -> list[Figure]:
    """One figure per logged name, with one line per run that logged it.

    Runs whose folders have the same name (the seeds of an arm) share a colour and an entry in the legend.
    """
    return [_figure(name, runs) for name in sorted({name for curves in runs.values() for name in curves})]


def _figure(name: str, runs: dict[str, Curves]) -> Figure:
    lines: dict[str, list[list[tuple[int, float]]]] = {}  # folder name -> its runs' points
    for run, curves in runs.items():
        if name in curves:
            lines.setdefault(Path(run).name, []).append(curves[name])
    legend_rows = -(-len(lines) // LEGEND_COLUMNS) if len(runs) > 1 else 0
    figure = Figure(figsize=(3.6, 2.4 + 0.15 * legend_rows), layout="constrained")
    axes = figure.subplots()
    for index, (label, of_label) in enumerate(lines.items()):
        for number, points in enumerate(of_label):
            axes.plot(
                *zip(*points, strict=True),
                color=COLOURS[
                    (2 * index + index // 10) % 20
                ],  # the ten strong ones, then their pale partners
                linewidth=1.2,
                label=None if number else short(label),
            )
    lowest, highest = axes.dataLim.ymin, axes.dataLim.ymax
    if lowest > 0 and highest > 10 * lowest:  # a loss whose first steps would hide the rest
        axes.set_yscale("log")
    axes.set_title(name, fontsize=10)
    axes.set_xlabel("step", fontsize=8)
    axes.tick_params(labelsize=8)
    axes.grid(alpha=0.3)
    if len(runs) > 1:
        figure.legend(loc="outside lower center", ncols=LEGEND_COLUMNS, fontsize=7, frameon=False)
    return figure
