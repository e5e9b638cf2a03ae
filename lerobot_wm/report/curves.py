"""Training curves from the `train_log.jsonl` of runs."""

import json
from pathlib import Path

from matplotlib.figure import Figure

LOG_NAME = "train_log.jsonl"
# LeRobot's counters and timings, which say nothing about learning.
BOOKKEEPING = {"steps", "samples", "episodes", "epochs", "update_s", "dataloading_s", "samples_per_s"}
# One run as {name: [(step, value), ...]}.
Curves = dict[str, list[tuple[int, float]]]


def read_curves(run: Path) -> Curves:
    """The losses and other measures a run logged by name, against the step.

    Raises:
        FileNotFoundError: the folder holds no log.
    """
    path = run / LOG_NAME
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
    return curves


def curve_figures(runs: dict[str, Curves]) -> list[Figure]:
    """One figure per logged name, with one line per run that logged it."""
    return [_figure(name, runs) for name in sorted({name for curves in runs.values() for name in curves})]


def _figure(name: str, runs: dict[str, Curves]) -> Figure:
    figure = Figure(figsize=(3.6, 2.4), layout="constrained")
    axes = figure.subplots()
    for run, curves in runs.items():
        if name in curves:
            axes.plot(*zip(*curves[name], strict=True), linewidth=1.2, label=run)
    lowest, highest = axes.dataLim.ymin, axes.dataLim.ymax
    if lowest > 0 and highest > 10 * lowest:  # a loss whose first steps would hide the rest
        axes.set_yscale("log")
    axes.set_title(name, fontsize=10)
    axes.set_xlabel("step", fontsize=8)
    axes.tick_params(labelsize=8)
    axes.grid(alpha=0.3)
    if len(runs) > 1:
        axes.legend(fontsize=7)
    return figure
