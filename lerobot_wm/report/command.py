"""`lerobot-wm report`: records -> success tables in the terminal and one self-contained HTML page."""

from dataclasses import dataclass
from pathlib import Path

import draccus
from lerobot.datasets.dataset_metadata import LeRobotDatasetMetadata
from rich.console import Console

from lerobot_wm.data.options import SourceConfig
from lerobot_wm.inspect.dream_figures import dream_clips
from lerobot_wm.inspect.episodes import check_features
from lerobot_wm.inspect.html import PNG, SVG, data_uri, figure_bytes
from lerobot_wm.inspect.latent_map import latent_figures, latent_map
from lerobot_wm.inspect.open_loop import load_world_model, open_loop, strips_figure
from lerobot_wm.inspect.quality_figures import quality_section
from lerobot_wm.policies.latent.policy import LatentPolicy
from lerobot_wm.policies.wm_rssm.modeling_wm_rssm import WMRSSMPolicy
from lerobot_wm.records import by_machine, find_records, provenance, read_records
from lerobot_wm.report.curves import curve_figures, read_logs
from lerobot_wm.report.data_summary import summarise_data
from lerobot_wm.report.page import Page, page_of_records
from lerobot_wm.report.videos import read_evaluation
from lerobot_wm.tables import markdown_table, terminal_tables

TERMINAL_WIDTH = 100


@dataclass
class ReportConfig:
    """Flags of `lerobot-wm report`; lists are separated by commas."""

    # Records files or globs, as written by `lerobot-wm eval`.
    records: str
    output_dir: Path = Path("outputs/report")
    title: str = "World-model policies"
    # Output folders of `lerobot-wm eval` whose videos are shown.
    videos: str | None = None
    # Output folders of `lerobot-wm train` whose curves are shown.
    train_logs: str | None = None
    # Checkpoint of wm_rssm, wm_bc or wm_iql whose dreams, predictions and latents of `--dataset.*` are shown.
    world_model_path: str | None = None
    # The dataset that the page describes, and whose episodes the world model imagines.
    dataset: SourceConfig | None = None
    # quality.json of `lerobot-wm quality`, whose section is included.
    quality: Path | None = None

    def validate(self) -> None:
        """Refuse a world model that has nothing to imagine.

        Raises:
            ValueError: a world model without a dataset.
        """
        if self.world_model_path is not None and self.dataset is None:
            raise ValueError(
                f"--world_model_path={self.world_model_path} needs --dataset.repo_id (and --dataset.root for a local "
                "one) as well: the image dataset whose episodes it shall imagine."
            )


def report(cfg: ReportConfig) -> Path:
    """Print the success tables; write `index.html`, `success.md` and, with a world model, `open_loop.png`.

    Returns:
        The page.

    Raises:
        ValueError, FileNotFoundError: an input is missing, not whole or not what its flag takes.
    """
    cfg.validate()
    meta = policy = None
    if cfg.dataset is not None:
        meta = cfg.dataset.metadata()
        if cfg.world_model_path is not None:
            policy = load_world_model(cfg.world_model_path)
            check_features(policy, meta)
    records = read_records(find_records(cfg.records))
    evaluations = [read_evaluation(folder) for folder in _paths(cfg.videos)]
    clips = [clip for evaluation in evaluations for clip in evaluation.clips]
    page = page_of_records(cfg.title, records, clips)
    page.made_by = by_machine([*(evaluation.provenance for evaluation in evaluations), provenance()])
    curves = curve_figures(read_logs(_paths(cfg.train_logs)))
    page.curves = [data_uri(figure_bytes(figure, SVG), SVG) for figure in curves]
    if cfg.quality is not None:
        page.quality = quality_section(cfg.quality)
    cfg.output_dir.mkdir(parents=True, exist_ok=True)
    if cfg.dataset is not None and meta is not None:
        page.data = summarise_data(meta, cfg.dataset)
        if policy is not None:
            _show_world_model(page, policy, meta, cfg.dataset)
    if page.open_loop:
        picture = figure_bytes(strips_figure(page.open_loop), PNG)
        page.strips = data_uri(picture, PNG)
        (cfg.output_dir / "open_loop.png").write_bytes(picture)

    tables = [*page.tables, page.paper_table, *page.comparison_tables]
    shown = [table for table in tables if table is not None]
    console = Console(width=TERMINAL_WIDTH)
    for table in shown:
        console.print(*terminal_tables(table))
    (cfg.output_dir / "success.md").write_text("".join(map(markdown_table, [*shown, *page.detail_tables])))
    index = cfg.output_dir / "index.html"
    index.write_text(page.html())
    return index


def _show_world_model(
    page: Page, policy: WMRSSMPolicy | LatentPolicy, meta: LeRobotDatasetMetadata, source: SourceConfig
) -> None:
    """Put on the page what a world model imagines of a dataset and knows of it."""
    page.dataset = meta.repo_id
    page.open_loop = open_loop(policy, meta, source)
    page.dreams = dream_clips(policy, meta, source)
    page.latents = latent_map(policy, meta, source)
    page.latent_pictures = [data_uri(figure_bytes(f, PNG), PNG) for f in latent_figures(page.latents)]


def _paths(comma_separated: str | None) -> list[Path]:
    return [Path(path.strip()) for path in comma_separated.split(",")] if comma_separated else []


def main() -> None:
    """Entry point of `lerobot-wm report`."""
    index = report(draccus.parse(ReportConfig))
    print(f"Report: {index}")
