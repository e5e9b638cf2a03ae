"""The HTML page: what it shows, and its templates."""

from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

from jinja2 import Environment, FileSystemLoader, StrictUndefined
from matplotlib.figure import Figure

from lerobot_wm.inspect.latent_map import LatentMap
from lerobot_wm.inspect.open_loop import CONTEXT
from lerobot_wm.inspect.pictures import SVG, figure_uri, shorten
from lerobot_wm.records import Estimate, Record, SuccessRate, is_in_split, present_splits, success_rate
from lerobot_wm.report.arms import ARMS
from lerobot_wm.report.comparison import group_by_arm
from lerobot_wm.report.models import DreamClip, ReplaySummary
from lerobot_wm.report.rollouts import MAX_VIDEO_BYTES, Clip, Grid, make_grids, within_limit
from lerobot_wm.report.success import (
    comparison_tables,
    overall_table,
    paper_comparison,
    seed_table,
    task_table,
)
from lerobot_wm.report.training import DataSummary
from lerobot_wm.tables import Measurement, ReportTable, cell_text

SPLIT_COLOURS = {"seen": "#e08214", "unseen": "#2f6fde"}


@dataclass
class Page:
    """The content of a report; a section without content is left out.

    Attributes:
        title: The page's title.
        arms: Each arm of the rollouts, its preset, and what it is.
        n_rollouts: How many records of rollouts there are.
        tables, detail_tables, paper_table, comparison_tables: Success rates.
        grids: Which variations succeed and fail.
        split_picture: Success on seen and on unseen variations, a data URI.
        featured: The clips shown first.
        n_clips: How many videos are on the page, and how many there were.
        made_by: Commands, each list with the versions and the kind of machine they ran with.
        data: The dataset that is described.
        replay: How far policies are from recorded actions.
        dataset: Repo id of the dataset that the world model is shown.
        dreams: Dreams of some of its episodes.
        open_loop, strips: The table of open-loop prediction, and its picture as a data URI.
        latents, latent_pictures: The map of latents, and its pictures by task and by time as data URIs.
        quality: The world model's quality, see `read_quality`.
        curves: Training curves as data URIs, one for each logged quantity.
    """

    title: str
    arms: list[tuple[str, str, str]] = field(default_factory=list)
    n_rollouts: int = 0
    tables: list[ReportTable] = field(default_factory=list)
    detail_tables: list[ReportTable] = field(default_factory=list)
    paper_table: ReportTable | None = None
    comparison_tables: list[ReportTable] = field(default_factory=list)
    grids: list[Grid] = field(default_factory=list)
    split_picture: str = ""
    featured: list[Clip] = field(default_factory=list)
    n_clips: tuple[int, int] = (0, 0)
    made_by: list[tuple[list[str], dict[str, str]]] = field(default_factory=list)
    data: DataSummary | None = None
    replay: ReplaySummary | None = None
    dataset: str = ""
    dreams: list[DreamClip] = field(default_factory=list)
    open_loop: ReportTable | None = None
    strips: str = ""
    latents: LatentMap | None = None
    latent_pictures: list[str] = field(default_factory=list)
    quality: dict[str, Any] | None = None
    curves: list[str] = field(default_factory=list)

    @property
    def sections(self) -> dict[str, str]:
        """Headings of the sections that have content, by name, in the order of the page."""
        headings = {
            "data": "What was trained, and on which data" if self.arms else "The data" if self.data else "",
            "success": "Success rates" if self.tables else "",
            "videos": "Videos, and which variations fail" if self.grids else "",
            "replay": "How far the policy is from recorded actions" if self.replay else "",
            "imagination": "What the world model imagines" if self.open_loop or self.dreams else "",
            "knowledge": "What the world model knows" if self.latents or self.quality else "",
            "training": "Training curves" if self.curves else "",
            "provenance": "How to reproduce this page",
        }
        return {name: heading for name, heading in headings.items() if heading}

    def html(self) -> str:
        """One self-contained page: it loads nothing when it is opened, and its short script only plays videos."""
        page = template_environment().get_template("page.html.j2")
        video_megabytes = MAX_VIDEO_BYTES // 1_000_000
        return page.render(
            vars(self), sections=self.sections, context=CONTEXT, video_megabytes=video_megabytes
        )


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


def page_of_records(title: str, records: list[Record], clips: list[Clip]) -> Page:
    """A page of rollouts: what it shows of their records and videos."""
    inlined = within_limit(clips)
    # The first success and the first failure.
    first = {clip.success: clip for clip in reversed(inlined)}
    page = Page(
        title=title,
        arms=[
            (arm, runs[0]["preset"], ARMS[arm].description if arm in ARMS else "")
            for arm, runs in group_by_arm(records).items()
        ],
        n_rollouts=len(records),
        tables=[task_table("Success per task", records), overall_table(records)],
        detail_tables=_detail_tables(records),
        paper_table=paper_comparison(records),
        comparison_tables=comparison_tables(records),
        grids=make_grids(records, inlined),
        featured=[first[success] for success in (True, False) if success in first],
        n_clips=(len(inlined), len(clips)),
    )
    if len(present_splits(records)) > 1:
        page.split_picture = figure_uri(split_figure(records), SVG)
    return page


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
