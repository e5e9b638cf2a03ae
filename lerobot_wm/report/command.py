"""`lerobot-wm report`: one self-contained HTML page of what there is: data, curves, models, success of rollouts."""

from dataclasses import dataclass
from pathlib import Path

import draccus
from lerobot.datasets.dataset_metadata import LeRobotDatasetMetadata
from rich.console import Console

from lerobot_wm.data.source import SourceConfig
from lerobot_wm.inspect.episodes import ImaginingPolicy, check_features, load_world_model
from lerobot_wm.inspect.latent_map import latent_figures, latent_map
from lerobot_wm.inspect.open_loop import open_loop, psnr_table, strips_figure
from lerobot_wm.inspect.pictures import PNG, SVG, data_uri, figure_bytes, figure_uri
from lerobot_wm.records import COMMAND, find_records, provenance, read_records
from lerobot_wm.report.models import dream_clips, read_quality, read_replay
from lerobot_wm.report.page import Page, page_of_records
from lerobot_wm.report.rollouts import read_evaluation
from lerobot_wm.report.training import curve_figures, read_logs, summarise_data
from lerobot_wm.tables import markdown_table, terminal_tables

TERMINAL_WIDTH = 100


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
    page = Page(cfg.title)
    if cfg.records is not None:
        clips = [clip for evaluation in evaluations for clip in evaluation.clips]
        page = page_of_records(cfg.title, read_records(find_records(cfg.records)), clips)
    page.made_by = _group_by_machine([*(evaluation.provenance for evaluation in evaluations), provenance()])
    page.curves = [figure_uri(figure, SVG) for figure in curve_figures(read_logs(_paths(cfg.train_logs)))]
    if cfg.quality is not None:
        page.quality = read_quality(cfg.quality)
    if cfg.replay is not None:
        page.replay = read_replay(cfg.replay)
    if cfg.dataset is None and list(page.sections) == ["provenance"]:
        raise ValueError(
            "There is nothing to show: give --records (with or without --videos), --train_logs, --replay, --quality or "
            "--dataset.repo_id."
        )
    cfg.output_dir.mkdir(parents=True, exist_ok=True)
    if cfg.dataset is not None and meta is not None:
        page.data = summarise_data(meta, cfg.dataset)
        if policy is not None:
            _show_world_model(page, policy, meta, cfg.dataset, cfg.output_dir)

    success = [*page.tables, *([page.paper_table] if page.paper_table else []), *page.comparison_tables]
    console = Console(width=TERMINAL_WIDTH)
    for table in [*success, *([page.replay.table] if page.replay else [])]:
        console.print(*terminal_tables(table))
    if success:
        markdown = "".join(map(markdown_table, [*success, *page.detail_tables]))
        (cfg.output_dir / "success.md").write_text(markdown)
    index = cfg.output_dir / "index.html"
    index.write_text(page.html())
    return index


def _show_world_model(
    page: Page, policy: ImaginingPolicy, meta: LeRobotDatasetMetadata, source: SourceConfig, output_dir: Path
) -> None:
    """Put on the page what a world model imagines of a dataset and knows of it."""
    page.dataset = meta.repo_id
    predictions = open_loop(policy, meta, source)
    if predictions:
        picture = figure_bytes(strips_figure(predictions), PNG)
        (output_dir / "open_loop.png").write_bytes(picture)
        page.open_loop, page.strips = psnr_table(predictions), data_uri(picture, PNG)
    page.dreams = dream_clips(policy, meta, source)
    page.latents = latent_map(policy, meta, source)
    page.latent_pictures = [figure_uri(figure, PNG) for figure in latent_figures(page.latents)]


def _group_by_machine(results: list[dict[str, str]]) -> list[tuple[list[str], dict[str, str]]]:
    """Group the commands that produced results by the versions and kind of machine they ran with."""
    groups: dict[tuple[tuple[str, str], ...], list[str]] = {}
    for facts in results:
        shared = tuple((name, fact) for name, fact in facts.items() if name != COMMAND)
        groups.setdefault(shared, []).append(facts[COMMAND])
    return [(commands, dict(shared)) for shared, commands in groups.items()]


def _paths(comma_separated: str | None) -> list[Path]:
    return [Path(path.strip()) for path in comma_separated.split(",")] if comma_separated else []


def main() -> None:
    """Entry point of `lerobot-wm report`."""
    index = report(draccus.parse(ReportConfig))
    print(f"Report: {index}")
