"""`lerobot-wm report`: one self-contained HTML page of what there is: data, curves, models, success of rollouts."""

from dataclasses import dataclass
from pathlib import Path
from typing import Any

import draccus
from jinja2 import Environment, FileSystemLoader, StrictUndefined
from lerobot.datasets.dataset_metadata import LeRobotDatasetMetadata
from markupsafe import Markup
from matplotlib.figure import Figure
from rich.console import Console

from lerobot_wm.data.source import SourceConfig
from lerobot_wm.inspect.episodes import ImaginingPolicy, check_features, load_world_model
from lerobot_wm.inspect.latent_map import latent_figures, latent_map
from lerobot_wm.inspect.open_loop import CONTEXT, open_loop, psnr_table, strips_figure
from lerobot_wm.inspect.pictures import PNG, SVG, data_uri, figure_bytes, figure_uri, shorten
from lerobot_wm.records import (
    COMMAND,
    Estimate,
    Record,
    SuccessRate,
    find_records,
    is_in_split,
    present_splits,
    provenance,
    read_records,
    success_rate,
)
from lerobot_wm.report.arms import ARMS
from lerobot_wm.report.comparison import group_by_arm
from lerobot_wm.report.models import dream_clips, read_quality, read_replay
from lerobot_wm.report.rollouts import MAX_VIDEO_BYTES, Clip, make_grids, read_evaluation, within_limit
from lerobot_wm.report.success import (
    comparison_tables,
    overall_table,
    paper_comparison,
    seed_table,
    task_table,
    tier_table,
)
from lerobot_wm.report.training import curve_figures, read_logs, summarise_data
from lerobot_wm.tables import Measurement, ReportTable, cell_text, markdown_table, terminal_tables

TERMINAL_WIDTH = 100
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


@dataclass
class ReportConfig:
    """Flags of `lerobot-wm report`; lists are separated by commas. Each adds a section to the page.

    Args:
        records: Records files of `lerobot-wm eval`, or globs.
        output_dir: Where the page and its tables are written.
        title: The page's title.
        videos: Output folders of `lerobot-wm eval` whose videos are shown; needs `records`.
        train_logs: Output folders of `lerobot-wm train` whose curves are shown.
        world_model_path: Checkpoint of wm_rssm, wm_bc or wm_iql whose dreams, predictions and latents of `dataset` are
            shown.
        dataset: The dataset that is described, and that the world model is shown.
        quality: quality.json of `lerobot-wm quality`.
        replay: replay.json of `lerobot-wm replay`.
    """

    records: str | None = None
    output_dir: Path = Path("outputs/report")
    title: str = "World-model policies"
    videos: str | None = None
    train_logs: str | None = None
    world_model_path: str | None = None
    dataset: SourceConfig | None = None
    quality: Path | None = None
    replay: Path | None = None


def report(cfg: ReportConfig) -> Path:
    """Print the tables; write `index.html`, with records `success.md`, and with a world model `open_loop.png`.

    Returns:
        The page.

    Raises:
        ValueError, FileNotFoundError: An input is missing, damaged, or not what its flag takes.
    """
    meta = policy = None
    if cfg.dataset is not None:
        meta = cfg.dataset.metadata()
    if cfg.world_model_path is not None:
        if meta is None:
            raise ValueError(
                f"--world_model_path={cfg.world_model_path} needs --dataset.repo_id (and --dataset.root for a local "
                "dataset): the image dataset that the world model is shown."
            )
        policy = load_world_model(cfg.world_model_path)
        check_features(policy, meta)
    evaluations = [read_evaluation(folder) for folder in _paths(cfg.videos)]
    content: Content = {}
    tables: list[ReportTable] = []
    if cfg.records is not None:
        clips = [clip for evaluation in evaluations for clip in evaluation.clips]
        content = rollout_sections(read_records(find_records(cfg.records)), clips)
        success = content["success"]
        tables = [*success["tables"], *filter(None, [success["paper_table"]]), *success["comparison_tables"]]
    if cfg.replay is not None:
        content["replay"] = read_replay(cfg.replay)
    if cfg.train_logs is not None:
        figures = curve_figures(read_logs(_paths(cfg.train_logs)))
        content["training"] = {"curves": [figure_uri(figure, SVG) for figure in figures]}
    if cfg.quality is not None:
        content["knowledge"] = {"latents": None, "quality": read_quality(cfg.quality)}
    if cfg.dataset is None and not content:
        raise ValueError(
            "There is nothing to show: give --records (with or without --videos), --train_logs, --replay, --quality or "
            "--dataset.repo_id."
        )
    made_by = _group_by_machine([*(evaluation.provenance for evaluation in evaluations), provenance()])
    content["provenance"] = {"made_by": made_by, "has_rollouts": cfg.records is not None}
    cfg.output_dir.mkdir(parents=True, exist_ok=True)
    if cfg.dataset is not None and meta is not None:
        content["data"] = {"data": summarise_data(meta, cfg.dataset)}
        if policy is not None:
            _show_world_model(content, policy, meta, cfg.dataset, cfg.output_dir)

    if tables:
        markdown = "".join(map(markdown_table, [*tables, *content["success"]["detail_tables"]]))
        (cfg.output_dir / "success.md").write_text(markdown)
    if cfg.replay is not None:
        tables.append(content["replay"]["table"])
    console = Console(width=TERMINAL_WIDTH)
    for table in tables:
        console.print(*terminal_tables(table))
    index = cfg.output_dir / "index.html"
    index.write_text(render_page(cfg.title, content))
    return index


def _show_world_model(
    content: Content,
    policy: ImaginingPolicy,
    meta: LeRobotDatasetMetadata,
    source: SourceConfig,
    output_dir: Path,
) -> None:
    """Add what a world model imagines of a dataset and knows of it."""
    predictions = open_loop(policy, meta, source)
    table = strips = None
    if predictions:
        picture = figure_bytes(strips_figure(predictions), PNG)
        (output_dir / "open_loop.png").write_bytes(picture)
        table, strips = psnr_table(predictions), data_uri(picture, PNG)
    dreams = dream_clips(policy, meta, source)
    if dreams or predictions:
        content["imagination"] = {
            "dataset": meta.repo_id,
            "context": CONTEXT,
            "dreams": dreams,
            "open_loop": table,
            "strips": strips,
        }
    latents = latent_map(policy, meta, source)
    content["knowledge"] = {
        "quality": None,
        **content.get("knowledge", {}),
        "dataset": meta.repo_id,
        "latents": latents,
        "latent_pictures": [figure_uri(figure, PNG) for figure in latent_figures(latents)],
    }


def _group_by_machine(results: list[dict[str, str]]) -> list[tuple[list[str], dict[str, str]]]:
    """Group the commands that produced results by the versions and kind of machine they ran with."""
    groups: dict[tuple[tuple[str, str], ...], list[str]] = {}
    for facts in results:
        shared = tuple((name, fact) for name, fact in facts.items() if name != COMMAND)
        groups.setdefault(shared, []).append(facts[COMMAND])
    return [(commands, dict(shared)) for shared, commands in groups.items()]


def _paths(comma_separated: str | None) -> list[Path]:
    return [Path(path.strip()) for path in comma_separated.split(",")] if comma_separated else []


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
            "tables": [
                *filter(None, [tier_table(records)]),
                task_table("Success per task", records),
                overall_table(records),
            ],
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


def main() -> None:
    """Entry point of `lerobot-wm report`."""
    index = report(draccus.parse(ReportConfig))
    print(f"Report: {index}")
