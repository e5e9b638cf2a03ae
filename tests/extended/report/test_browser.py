"""The report in a real browser: from a file, without a network, on a desk and on a phone, with hostile names in it."""

import json
import os
import shutil
from collections.abc import Iterator
from dataclasses import dataclass, field
from pathlib import Path

import numpy as np
import pytest
from lerobot.utils.io_utils import write_video
from playwright.sync_api import Browser, BrowserContext, Page, sync_playwright

from lerobot_wm.constants import ACTION, OBS_IMAGE, OBS_STATE
from lerobot_wm.data.schema import COLLECTION_RECORD
from lerobot_wm.data.source import SourceConfig
from lerobot_wm.inspect.open_loop import WINDOW
from lerobot_wm.records import Record, record_line
from lerobot_wm.report.command import ReportConfig, report
from tests.recording import camera, record, vector

CHROMIUM = shutil.which("chromium")
INSTALL = "apt-get update && apt-get install -y --no-install-recommends chromium"
HOSTILE = "<img src=x onerror=alert(1)> for $1 or $_ & a_very_long_name_without_a_place_to_break"
PHONE_WIDTH = 390
PATIENCE_MS = 300_000  # of a machine that does much else

pytestmark = pytest.mark.skipif(CHROMIUM is None, reason=f"needs Chromium: {INSTALL}")


def record_hostile(root: Path) -> None:
    """Two tasks, one of them hostile, collected by hostile experts."""
    features = {OBS_IMAGE: camera(64, 64), OBS_STATE: vector(4), ACTION: vector(4)}
    record(root, features, [(HOSTILE, WINDOW), ("Open the lid", WINDOW + 5)])
    config = {"noise": 0.3, "variations": [0, 1], "variation_set": 42, "steps_after_success": 8}
    content = {
        "config": config,
        "experts": {HOSTILE: HOSTILE, "lid-v3": "LidPolicy"},
        "episodes": [{"task": HOSTILE}, {"task": "lid-v3"}],
    }
    (root / COLLECTION_RECORD).write_text(json.dumps(content))


def write_hostile_run(folder: Path, records: list[Record]) -> ReportConfig:
    """Records, videos and curves of arms and tasks with hostile names."""
    (folder / "records.jsonl").write_text("".join(map(record_line, records)))
    videos = folder / "eval" / "videos" / "reach-v3"
    videos.mkdir(parents=True)
    frames = [np.full((64, 64, 3), 10 * i, np.uint8) for i in range(8)]
    for name in ("variation_03_success", "variation_04_failure", "variation_05_failure"):
        write_video(videos / f"{name}.mp4", frames, fps=80)
    info = {"arm": HOSTILE, "provenance": {"command": f"lerobot-wm eval --arm='{HOSTILE}'"}}
    (folder / "eval" / "eval_info.json").write_text(json.dumps(info))
    run = folder / "wm"
    run.mkdir()
    entries = [{"step": step, "loss": 1 / step, "kl": 3.0} for step in (1, 2, 3)]
    (run / "train_log.jsonl").write_text("".join(json.dumps(entry) + "\n" for entry in entries))
    return ReportConfig(
        records=str(folder / "records.jsonl"),
        output_dir=folder / "report",
        title=f"Report of {HOSTILE}",
        videos=str(folder / "eval"),
        train_logs=str(run),
    )


@pytest.fixture(scope="module")
def index(
    tmp_path_factory: pytest.TempPathFactory, untrained_path: Path, quality_path: Path, replay_path: Path
) -> Path:
    """A page with every section."""
    folder = tmp_path_factory.mktemp("browser")
    record_hostile(folder / "data")
    runs = [(arm, task) for arm in (HOSTILE, "wm_iql") for task in ("reach-v3", HOSTILE)]
    records: list[Record] = [
        {
            "arm": arm,
            "policy_type": "wm_bc",
            "preset": "test",
            "seed": 0,
            "task": task,
            "variation": k,
            "seen": k < 10,
            "success": k % 3 == 0,
            "steps": 60,
            "return": 0.0,
        }
        for arm, task in runs
        for k in range(50)
    ]
    config = write_hostile_run(folder, records)
    config.quality = quality_path
    config.replay = replay_path
    config.world_model_path = str(untrained_path)
    config.dataset = SourceConfig("test/recorded", str(folder / "data"))
    return report(config)


@pytest.fixture(scope="module")
def browser() -> Iterator[Browser]:
    # Chromium's sandbox refuses to run for root.
    flags = ["--no-sandbox"] if os.geteuid() == 0 else []
    with sync_playwright() as playwright:
        chromium = playwright.chromium.launch(executable_path=CHROMIUM, args=flags, timeout=PATIENCE_MS)
        yield chromium
        chromium.close()


@dataclass
class Visit:
    """A page that was opened, and what the browser said and asked for meanwhile."""

    page: Page
    said: list[str] = field(default_factory=list)
    requested: list[str] = field(default_factory=list)

    @classmethod
    def of(cls, index: Path, context: BrowserContext) -> "Visit":
        context.set_default_timeout(PATIENCE_MS)
        context.set_offline(True)
        visit = cls(context.new_page())
        visit.page.on("console", lambda message: visit.said.append(f"{message.type}: {message.text}"))
        visit.page.on("pageerror", lambda error: visit.said.append(f"error: {error}"))
        visit.page.on("dialog", lambda dialog: (visit.said.append(dialog.message), dialog.dismiss()))
        visit.page.on("request", lambda request: visit.requested.append(request.url))
        visit.page.goto(index.as_uri())
        # What is folded away is looked at too.
        visit.page.evaluate("document.querySelectorAll('details').forEach(d => d.open = true)")
        return visit


@pytest.fixture(scope="module")
def desk(index: Path, browser: Browser) -> Iterator[Visit]:
    with browser.new_context(viewport={"width": 1280, "height": 900}) as context:
        yield Visit.of(index, context)


@pytest.fixture(scope="module")
def phone(index: Path, browser: Browser) -> Iterator[Visit]:
    screen = {"width": PHONE_WIDTH, "height": 844}
    with browser.new_context(viewport=screen, is_mobile=True, has_touch=True) as context:
        yield Visit.of(index, context)


def test_every_section_is_there(desk: Visit) -> None:
    assert desk.page.locator("h2").all_inner_texts() == desk.page.locator("nav a").all_inner_texts()
    assert desk.page.locator("h2").count() == 8


def test_every_picture_and_video_loads(desk: Visit) -> None:
    images, videos = desk.page.locator("img"), desk.page.locator("video[src]")
    assert images.count() == 2 + 1 + 1 + 2 + 1 + 2 + 5 + 2, (
        "data, seen, replay, dreams, open loop, latents, quality, curves"
    )
    desk.page.wait_for_function("Array.from(document.images).every(i => i.complete)")
    assert min(images.evaluate_all("all => all.map(i => i.naturalWidth)")) > 0
    assert videos.count() == 2 + 2, "a success, a failure, and dreams"
    desk.page.wait_for_function(
        "Array.from(document.querySelectorAll('video[src]')).every(v => v.readyState >= 1 || v.error)"
    )
    assert min(videos.evaluate_all("all => all.map(v => v.videoWidth)")) > 0


def test_videos_of_the_grid_play(desk: Visit) -> None:
    buttons = desk.page.locator("button[data-src]")
    assert buttons.count() == 3
    for number in range(3):
        buttons.nth(number).click()
        assert desk.page.locator("dialog[open] p").inner_text() == buttons.nth(number).get_attribute(
            "data-caption"
        )
        desk.page.wait_for_function("document.querySelector('dialog video').readyState >= 1")
        assert desk.page.locator("dialog video").evaluate("v => v.videoWidth") == 64
        desk.page.locator("dialog[open] button").click()
    assert desk.page.locator("dialog[open]").count() == 0


def test_hostile_names_are_text(desk: Visit) -> None:
    for section in ("data", "success", "videos", "imagination", "knowledge"):
        assert HOSTILE in desk.page.locator(f"#{section}").inner_text(), section
    assert desk.page.title() == f"Report of {HOSTILE}"
    assert desk.page.locator("img[onerror], img[src=x]").count() == 0


def test_the_page_fits_a_phone(phone: Visit) -> None:
    width, scroll = phone.page.evaluate("[innerWidth, document.documentElement.scrollWidth]")
    assert (width, scroll) == (PHONE_WIDTH, PHONE_WIDTH)
    assert phone.page.locator("h2").count() == 8
    # Tables that are too wide scroll in a box of their own.
    boxes = phone.page.locator(".wide").evaluate_all(
        "all => all.map(b => [b.scrollWidth > b.clientWidth, getComputedStyle(b).overflowX])"
    )
    assert [True, "auto"] in boxes
    assert {overflow for _, overflow in boxes} == {"auto"}


@pytest.mark.parametrize("screen", ["desk", "phone"])
def test_nothing_is_complained_of_or_fetched(screen: str, request: pytest.FixtureRequest) -> None:
    visit: Visit = request.getfixturevalue(screen)
    assert visit.said == []
    assert visit.requested == [visit.page.url], "the page itself; what it holds as data: is no request"
