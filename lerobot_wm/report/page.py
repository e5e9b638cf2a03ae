"""The HTML page: what it shows, and its template."""

from dataclasses import dataclass, field
from pathlib import Path

from jinja2 import Environment, FileSystemLoader, StrictUndefined

from lerobot_wm.report.open_loop import CONTEXT, HORIZONS, OpenLoop
from lerobot_wm.report.tables import SuccessTable
from lerobot_wm.report.videos import Clip


@dataclass
class Page:
    """The content of a report; a section without content is left out."""

    title: str
    table: SuccessTable
    run_tables: list[SuccessTable]
    n_rollouts: int
    has_splits: bool  # whether records tell seen from unseen variations
    provenance: dict[str, str]
    commands: list[str] = field(default_factory=list)
    clips: list[Clip] = field(default_factory=list)
    open_loop: list[OpenLoop] = field(default_factory=list)
    strips: str = ""  # data URI of the strips' picture
    dataset: str = ""  # repo id of the dataset the strips are of
    curves: list[str] = field(default_factory=list)  # data URIs, one per logged quantity

    def html(self) -> str:
        """One self-contained page: no scripts, and nothing is fetched when it is opened."""
        environment = Environment(
            loader=FileSystemLoader(Path(__file__).parent),
            autoescape=True,
            undefined=StrictUndefined,
            trim_blocks=True,
            lstrip_blocks=True,
        )
        return environment.get_template("page.html.j2").render(vars(self), context=CONTEXT, horizons=HORIZONS)
