"""The HTML page: what it shows, and its template."""

from dataclasses import dataclass, field

from matplotlib.figure import Figure

from lerobot_wm.inspect.dream_figures import DreamClip
from lerobot_wm.inspect.html import SVG, data_uri, figure_bytes, short, template_environment
from lerobot_wm.inspect.latent_map import LatentMap
from lerobot_wm.inspect.open_loop import CONTEXT, HORIZONS, OpenLoop
from lerobot_wm.records import Record, by_task
from lerobot_wm.report.arms import ARMS
from lerobot_wm.report.comparison import by_arm
from lerobot_wm.report.data_summary import DataSummary
from lerobot_wm.report.success import (
    comparison_tables,
    overall_table,
    paper_comparison,
    seed_table,
    task_table,
)
from lerobot_wm.report.videos import MAX_VIDEO_BYTES, Clip, within_limit
from lerobot_wm.statistics import Estimate, SuccessRate, in_split, success_rate
from lerobot_wm.tables import ReportTable, cell_text, present_splits


@dataclass(frozen=True)
class Outcome:
    """The rollouts of one arm on one variation, one per training seed."""

    successes: int
    n: int
    clip: Clip | None

    @property
    def kind(self) -> str:
        """ "success" or "failure" of all, or "mixed"."""
        if self.successes == self.n:
            return "success"
        return "mixed" if self.successes else "failure"


@dataclass(frozen=True)
class OutcomeGrid:
    """One task: a row of outcomes per arm, None where a variation was not rolled out."""

    task: str
    variations: list[int]
    n_seen: int  # how many of the variations, the first ones, occur in the training data
    rows: list[tuple[str, list[Outcome | None]]]


def outcome_grids(records: list[Record], clips: list[Clip]) -> list[OutcomeGrid]:
    """A grid for each task; of several videos of a cell the first is shown."""
    videos: dict[tuple[str, str, int], Clip] = {}
    for clip in clips:
        videos.setdefault((clip.arm, clip.task, clip.variation), clip)
    grids = []
    for task, of_task in by_task(records).items():
        seen = {record["variation"] for record in of_task if record["seen"]}
        others = {record["variation"] for record in of_task} - seen
        variations = [*sorted(seen), *sorted(others)]
        rows: list[tuple[str, list[Outcome | None]]] = []
        for arm, of_arm in by_arm(of_task).items():
            results: dict[int, list[bool]] = {}
            for record in of_arm:
                results.setdefault(record["variation"], []).append(record["success"])
            cells = [
                Outcome(sum(results[v]), len(results[v]), videos.get((arm, task, v)))
                if v in results
                else None
                for v in variations
            ]
            rows.append((arm, cells))
        grids.append(OutcomeGrid(task, variations, len(seen), rows))
    return grids


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


@dataclass
class Page:
    """The content of a report; a section without content is left out."""

    title: str
    arms: list[tuple[str, str, str]]  # arm, preset, what it is
    n_rollouts: int
    tables: list[ReportTable]
    detail_tables: list[ReportTable]
    paper_table: ReportTable | None
    comparison_tables: list[ReportTable]
    grids: list[OutcomeGrid]
    split_picture: str = ""  # data URI
    featured: list[Clip] = field(default_factory=list)  # shown before all others
    n_clips: tuple[int, int] = (0, 0)  # videos on the page, videos there were
    video_megabytes: int = 0  # the limit on all videos together
    made_by: list[tuple[list[str], dict[str, str]]] = field(default_factory=list)  # see `by_machine`
    data: DataSummary | None = None
    dataset: str = ""  # repo id of the dataset that the world model imagines and knows
    dreams: list[DreamClip] = field(default_factory=list)
    open_loop: list[OpenLoop] = field(default_factory=list)
    strips: str = ""  # data URI of the strips' picture
    latents: LatentMap | None = None
    latent_pictures: list[str] = field(default_factory=list)  # data URIs: by task, by time
    quality: str = ""  # HTML of the world model's quality
    curves: list[str] = field(default_factory=list)  # data URIs, one per logged quantity

    @property
    def sections(self) -> dict[str, str]:
        """Headings of the sections that have content, by name, in the order of the story that the page tells."""
        headings = {
            "data": "What was trained, and on what",
            "success": "How well it works",
            "videos": "Watch it",
            "imagination": "What the world model imagines" if self.open_loop or self.dreams else "",
            "knowledge": "What the world model knows" if self.latents or self.quality else "",
            "training": "How training went" if self.curves else "",
            "provenance": "How to make it again",
        }
        return {name: heading for name, heading in headings.items() if heading}

    def html(self) -> str:
        """One self-contained page: nothing is fetched when it is opened; its few lines of script play videos."""
        environment = template_environment()
        environment.tests["rate"] = lambda cell: isinstance(cell, SuccessRate | Estimate)
        environment.tests["counted"] = lambda cell: isinstance(cell, SuccessRate)
        environment.filters["text"] = cell_text
        return environment.get_template("page.html.j2").render(
            vars(self), sections=self.sections, context=CONTEXT, horizons=HORIZONS
        )


def page_of_records(title: str, records: list[Record], clips: list[Clip]) -> Page:
    """What the page shows of the records and of the videos of their rollouts."""
    inlined = within_limit(clips)
    page = Page(
        title=title,
        arms=[
            (arm, runs[0]["preset"], ARMS[arm].description if arm in ARMS else "")
            for arm, runs in by_arm(records).items()
        ],
        n_rollouts=len(records),
        tables=[task_table("Success per task", records), overall_table(records)],
        detail_tables=_detail_tables(records),
        paper_table=paper_comparison(records),
        comparison_tables=comparison_tables(records),
        grids=outcome_grids(records, inlined),
        featured=_featured(inlined),
        n_clips=(len(inlined), len(clips)),
        video_megabytes=MAX_VIDEO_BYTES // 1_000_000,
    )
    if len(present_splits(records)) > 1:
        page.split_picture = data_uri(figure_bytes(split_figure(records), SVG), SVG)
    return page


def _detail_tables(records: list[Record]) -> list[ReportTable]:
    """Per task: seen and unseen variations apart, and each training seed where an arm has several."""
    tables = [
        task_table(f"Success per task, {split} variations", [r for r in records if in_split(r, split)])
        for split in present_splits(records)
        if split != "all"
    ]
    runs = {(record["arm"], record["seed"]) for record in records}
    return [*tables, seed_table(records)] if len(runs) > len(by_arm(records)) else tables


def _featured(clips: list[Clip]) -> list[Clip]:
    """The first success and the first failure, where there are such."""
    first = {clip.success: clip for clip in reversed(clips)}
    return [first[success] for success in (True, False) if success in first]
