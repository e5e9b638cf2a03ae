"""The HTML page: what it shows, and its templates."""

from pathlib import Path
from typing import Any

from jinja2 import Environment, FileSystemLoader, StrictUndefined
from markupsafe import Markup
from matplotlib.figure import Figure

from lerobot_wm.inspect.pictures import SVG, figure_uri, shorten
from lerobot_wm.records import Estimate, Record, SuccessRate, is_in_split, present_splits, success_rate
from lerobot_wm.report.arms import ARMS
from lerobot_wm.report.comparison import group_by_arm
from lerobot_wm.report.rollouts import MAX_VIDEO_BYTES, Clip, make_grids, within_limit
from lerobot_wm.report.success import (
    comparison_tables,
    overall_table,
    paper_comparison,
    seed_table,
    task_table,
)
from lerobot_wm.tables import Measurement, ReportTable, cell_text

SPLIT_COLOURS = {"seen": "#e08214", "unseen": "#2f6fde"}


# The sections in the page's order, each with its heading; `<name>_section.html.j2` is its template.
HEADINGS = {
    "data": "The data",
    "success": "Success rates",
    "videos": "Videos, and which variations fail",
    "replay": "How far the policy is from recorded actions",
    "imagination": "What the world model imagines",
    "knowledge": "What the world model knows",
    "training": "Training curves",
    "provenance": "How to reproduce this page",
}
# What the template of each section shows, by the section's name.
Content = dict[str, dict[str, Any]]


def render_page(title: str, content: Content) -> str:
    """One self-contained page: it loads nothing when it is opened, and its short script only plays videos.

    Args:
        title: The page's title.
        content: The sections; others are left out.
    """
    environment = template_environment()
    sections = [
        (name, heading, Markup(environment.get_template(f"{name}_section.html.j2").render(content[name])))
        for name, heading in HEADINGS.items()
        if name in content
    ]
    return environment.get_template("page.html.j2").render(title=title, sections=sections)


def template_environment() -> Environment:
    """Jinja for report/templates: values are escaped, and an unknown name is an error."""
    environment = Environment(
        loader=FileSystemLoader(Path(__file__).with_name("templates")),
        autoescape=True,
        undefined=StrictUndefined,
        trim_blocks=True,
        lstrip_blocks=True,
    )
    environment.tests["rate"] = lambda cell: isinstance(cell, SuccessRate | Estimate)
    environment.tests["counted"] = lambda cell: isinstance(cell, SuccessRate)
    environment.tests["measurement"] = lambda cell: isinstance(cell, Measurement)
    environment.filters["text"] = cell_text
    return environment


def rollout_sections(records: list[Record], clips: list[Clip]) -> Content:
    """What the page shows of records and of the videos of their rollouts."""
    inlined = within_limit(clips)
    # The first success and the first failure.
    first = {clip.success: clip for clip in reversed(inlined)}
    return {
        "success": {
            "arms": [
                (arm, runs[0]["preset"], ARMS[arm].description if arm in ARMS else "")
                for arm, runs in group_by_arm(records).items()
            ],
            "n_rollouts": len(records),
            "tables": [task_table("Success per task", records), overall_table(records)],
            "detail_tables": _detail_tables(records),
            "paper_table": paper_comparison(records),
            "comparison_tables": comparison_tables(records),
            "split_picture": figure_uri(split_figure(records), SVG)
            if len(present_splits(records)) > 1
            else None,
        },
        "videos": {
            "grids": make_grids(records, inlined),
            "featured": [first[success] for success in (True, False) if success in first],
            "n_clips": (len(inlined), len(clips)),
            "video_megabytes": MAX_VIDEO_BYTES // 1_000_000,
        },
    }


def _detail_tables(records: list[Record]) -> list[ReportTable]:
    """Per task: seen and unseen variations apart, and each training seed where an arm has several."""
    tables = [
        task_table(f"Success per task, {split} variations", [r for r in records if is_in_split(r, split)])
        for split in present_splits(records)
        if split != "all"
    ]
    runs = {(record["arm"], record["seed"]) for record in records}
    return [*tables, seed_table(records)] if len(runs) > len(group_by_arm(records)) else tables


def split_figure(records: list[Record]) -> Figure:
    """Success over all tasks with Wilson 95% intervals, on seen and on unseen variations."""
    arms = group_by_arm(records)
    figure = Figure(figsize=(5.6, 1.1 + 0.34 * len(arms)), layout="constrained")
    axes = figure.subplots()
    for (split, colour), shift in zip(SPLIT_COLOURS.items(), (-0.14, 0.14), strict=True):
        for row, of_arm in enumerate(arms.values()):
            rate = success_rate(r for r in of_arm if is_in_split(r, split))
            if rate is not None:
                axes.plot(rate.interval, [row + shift] * 2, color=colour, linewidth=2, alpha=0.5)
                axes.plot(rate.percent, row + shift, "o", color=colour, markersize=6, clip_on=False)
        axes.plot([], [], "o-", color=colour, label=split)
    axes.set_yticks(range(len(arms)), [shorten(arm) for arm in arms])
    # The first arm on top; every arm has a whole row.
    axes.set_ylim(len(arms) - 0.5, -0.5)
    axes.set_xlim(0, 100)
    axes.set_xlabel("success, % of rollouts over all tasks")
    axes.grid(axis="x", alpha=0.3)
    axes.spines[["top", "right"]].set_visible(False)
    figure.legend(loc="outside upper right", ncols=2, frameon=False)
    return figure
