"""Seen against unseen variations, one row per arm."""

from matplotlib.figure import Figure

from lerobot_wm.report.arms import by_arm
from lerobot_wm.report.inline import short
from lerobot_wm.report.records import Record
from lerobot_wm.report.statistics import in_split, success_rate

COLOURS = {"seen": "#e08214", "unseen": "#2f6fde"}


def split_figure(records: list[Record]) -> Figure:
    """Success over all tasks with Wilson 95% intervals, on seen and on unseen variations.

    Records without the notion of seen variations (`seen` None) are not drawn.
    """
    arms = by_arm(records)
    figure = Figure(figsize=(5.6, 1.1 + 0.34 * len(arms)), layout="constrained")
    axes = figure.subplots()
    for (split, colour), shift in zip(COLOURS.items(), (-0.14, 0.14), strict=True):
        for row, of_arm in enumerate(arms.values()):
            rate = success_rate(r for r in of_arm if in_split(r, split))
            if rate is not None:
                axes.plot(rate.interval, [row + shift] * 2, color=colour, linewidth=2, alpha=0.5)
                axes.plot(rate.percent, row + shift, "o", color=colour, markersize=6, clip_on=False)
        axes.plot([], [], "o-", color=colour, label=split)
    axes.set_yticks(range(len(arms)), [short(arm) for arm in arms])
    axes.set_ylim(len(arms) - 0.5, -0.5)  # first arm on top; whole rows, whatever is drawn in them
    axes.set_xlim(0, 100)
    axes.set_xlabel("success, % of rollouts over all tasks")
    axes.grid(axis="x", alpha=0.3)
    axes.spines[["top", "right"]].set_visible(False)
    figure.legend(loc="outside upper right", ncols=2, frameon=False)
    return figure
