"""The HTML page: what it shows, and its template."""

from dataclasses import dataclass, field

from lerobot_wm.report.arms import ARMS, by_arm
from lerobot_wm.report.bootstrap import Estimate
from lerobot_wm.report.data_summary import DataSummary
from lerobot_wm.report.dream_clips import DreamClip
from lerobot_wm.report.inline import SVG, data_uri, figure_bytes
from lerobot_wm.report.latents import LatentMap
from lerobot_wm.report.open_loop import CONTEXT, HORIZONS, OpenLoop
from lerobot_wm.report.outcomes import OutcomeGrid, outcome_grids
from lerobot_wm.report.records import Record
from lerobot_wm.report.split_figure import split_figure
from lerobot_wm.report.statistics import SuccessRate, in_split
from lerobot_wm.report.success import (
    comparison_tables,
    overall_table,
    paper_comparison,
    seed_table,
    task_table,
)
from lerobot_wm.report.tables import ReportTable, cell_text, present_splits
from lerobot_wm.report.templates import template_environment
from lerobot_wm.report.videos import MAX_VIDEO_BYTES, Clip, within_limit


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
        arms=[(arm, runs[0]["preset"], ARMS.get(arm, "")) for arm, runs in by_arm(records).items()],
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
