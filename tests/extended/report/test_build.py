"""`lerobot-wm report`: from records alone, and with everything."""

import json
import re
import sys
from collections.abc import Callable
from html.parser import HTMLParser
from pathlib import Path

import numpy as np
import pytest
from lerobot.utils.io_utils import write_video
from PIL import Image

from lerobot_wm import cli
from lerobot_wm.data.source import SourceConfig
from lerobot_wm.inspect.pictures import MP4, PNG, data_uri
from lerobot_wm.inspect.replay import REPEAT
from lerobot_wm.records import record_line
from lerobot_wm.report import rollouts
from lerobot_wm.report.command import ReportConfig, report
from tests.recording import record_stranger

VOID = {"meta", "img", "br"}


class Page(HTMLParser):
    """What a page holds: its headings, sources and text; fails on tags that do not nest."""

    def __init__(self, path: Path) -> None:
        super().__init__()
        self.open, self.sources, self.captions, self.headings, self.text = [], [], [], [], ""
        self.links, self.anchors = [], []
        self.feed(path.read_text())
        assert not self.open
        assert self.links == [f"#{anchor}" for anchor in self.anchors], "the contents list every section"

    def handle_starttag(self, tag: str, attrs: list) -> None:
        self.sources += [(tag, value) for name, value in attrs if name in ("src", "data-src")]
        self.links += [value for name, value in attrs if name == "href"]
        self.anchors += [value for name, value in attrs if tag == "section" and name == "id"]
        self.captions += [value for name, value in attrs if name == "data-caption"]
        if tag not in VOID:
            self.open.append(tag)

    def handle_endtag(self, tag: str) -> None:
        assert self.open.pop() == tag

    def handle_data(self, data: str) -> None:
        self.text += data
        if self.open and self.open[-1] == "h2":
            self.headings.append(data)


def test_records_alone(
    records_file: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture
) -> None:
    flags = [f"--records={records_file}", f"--output_dir={tmp_path}/report", "--title=R&D <1>"]
    monkeypatch.setattr(sys, "argv", ["lerobot-wm", "report", *flags])
    cli.main()
    printed = capsys.readouterr().out
    assert "50/50  100 [93, 100]" in printed
    assert "+7.0 [" in printed, "wm_bc against wm_iql"
    assert f"{tmp_path}/report/index.html" in printed

    page = Page(tmp_path / "report" / "index.html")
    assert page.anchors == ["success", "videos", "provenance"]
    assert "R&D <1>" in page.text
    assert re.search(r"100% +50/50\s+\[93, 100\]", page.text)
    assert "[0.61, 1.65]" in page.text, "a table's notes"
    assert "lerobot-wm report" in page.text
    assert [tag for tag, _ in page.sources] == ["img"], "seen and unseen"
    markdown = (tmp_path / "report" / "success.md").read_text()
    assert "| wm_bc | 19/50  38 [26, 52] | 50/50  100 [93, 100] |" in markdown
    assert "## Success per task, unseen variations" in markdown
    assert not (tmp_path / "report" / "open_loop.png").exists()


def test_a_robot_needs_no_rollouts(
    tmp_path: Path,
    untrained_path: Path,
    episodes_root: Path,
    replay_path: Path,
    lerobot_wm_command: Callable[..., None],
    capsys: pytest.CaptureFixture,
) -> None:
    run = write_log(tmp_path / "world_model")
    lerobot_wm_command(
        f"report --train_logs={run} --replay={replay_path} --world_model_path={untrained_path}",
        f"--dataset.repo_id=test/episodes --dataset.root={episodes_root} --output_dir={tmp_path}/report",
    )
    assert REPEAT in capsys.readouterr().out
    page = Page(tmp_path / "report" / "index.html")
    assert page.anchors == ["data", "replay", "imagination", "knowledge", "training", "provenance"]
    assert page.headings[0] == "The data"
    error = json.loads(replay_path.read_text())["error_in_std"][REPEAT]["trained"]
    assert f"{error:.3f}" in page.text
    figure = (replay_path.parent / "episode_1.png").read_bytes()
    assert ("img", data_uri(figure, PNG)) in page.sources
    assert "Episode 1" in page.text
    assert "eval_info.json" not in page.text
    assert not (tmp_path / "report" / "success.md").exists()


def test_a_page_without_content_is_not_written(tmp_path: Path) -> None:
    with pytest.raises(ValueError, match=r"--records.*--replay"):
        report(ReportConfig(output_dir=tmp_path / "report", videos=str(write_evaluation(tmp_path / "eval"))))
    assert not (tmp_path / "report").exists()


def write_log(run: Path) -> Path:
    """An output folder of `lerobot-wm train` with a log of three steps."""
    run.mkdir()
    entries = [
        {"step": step, "steps": step, "loss": 1 / step, "kl": 3.0, "update_s": 0.1} for step in (1, 2, 3)
    ]
    (run / "train_log.jsonl").write_text("".join(json.dumps(entry) + "\n" for entry in entries))
    return run


def write_evaluation(folder: Path, *names: str) -> Path:
    """An output folder of `lerobot-wm eval` for arm wm_bc, with videos on reach-v3."""
    (folder / "videos" / "reach-v3").mkdir(parents=True)
    info = {"arm": "wm_bc", "provenance": {"command": "lerobot-wm eval --arm=wm_bc", "GPU": "a large one"}}
    (folder / "eval_info.json").write_text(json.dumps(info))
    for name in names:
        frames = [np.full((64, 64, 3), 10 * i, np.uint8) for i in range(8)]
        write_video(folder / "videos" / "reach-v3" / f"{name}.mp4", frames, fps=80)
    return folder


def test_everything(records_file: Path, tmp_path: Path, untrained_path: Path, episodes_root: Path) -> None:
    evaluation = write_evaluation(tmp_path / "eval", "variation_04_failure")
    run = write_log(tmp_path / "world_model")
    index = report(
        ReportConfig(
            records=str(records_file),
            output_dir=tmp_path / "report",
            videos=str(evaluation),
            train_logs=str(run),
            world_model_path=str(untrained_path),
            dataset=SourceConfig("test/episodes", str(episodes_root)),
        )
    )
    page = Page(index)
    assert page.anchors == [
        "data",
        "success",
        "videos",
        "imagination",
        "knowledge",
        "training",
        "provenance",
    ]
    kinds = [(tag, source.split(";")[0]) for tag, source in page.sources]
    assert kinds == [
        ("img", "data:image/webp"),  # how each task begins
        ("img", "data:image/webp"),
        ("img", "data:image/svg+xml"),  # seen and unseen
        ("video", "data:video/mp4"),  # the first failure, and in its cell of the grid
        ("button", "data:video/mp4"),
        ("video", "data:video/mp4"),  # a dream of each task, as a video and a strip
        ("img", "data:image/png"),
        ("video", "data:video/mp4"),
        ("img", "data:image/png"),
        ("img", "data:image/png"),  # open loop
        ("img", "data:image/png"),  # latents by task
        ("img", "data:image/png"),  # latents by time
        ("img", "data:image/svg+xml"),  # kl
        ("img", "data:image/svg+xml"),  # loss
    ], "everything is in the page, and nothing else is loaded"
    assert page.captions == ["reach-v3, wm_bc, variation 4: failure"]
    provenance = page.text.split("eval_info.json")[-1]
    assert re.search(r"lerobot-wm eval --arm=wm_bc\s+GPU\s*a large one\s", provenance), (
        "where it was evaluated"
    )
    assert provenance.count("GPU") == 2, "and where the page was written"
    assert "test/episodes" in page.text
    assert "116, 0.0 minutes at 80 frames per second" in page.text
    with Image.open(tmp_path / "report" / "open_loop.png") as picture:
        assert picture.width > 600


def test_episodes_too_short_to_imagine_do_not_cost_the_report(
    records_file: Path,
    tmp_path: Path,
    untrained_path: Path,
    episodes_root: Path,
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    monkeypatch.setattr("lerobot_wm.inspect.open_loop.WINDOW", 1000)
    dataset = SourceConfig("test/episodes", str(episodes_root))
    index = report(
        ReportConfig(
            records=str(records_file),
            output_dir=tmp_path / "report",
            world_model_path=str(untrained_path),
            dataset=dataset,
        )
    )
    page = Page(index)
    assert "imagination" in page.anchors, "dreams are of any length"
    assert sum(tag == "img" and source.startswith("data:image/png") for tag, source in page.sources) == 4
    assert not (tmp_path / "report" / "open_loop.png").exists()


def test_a_dataset_alone_is_described(records_file: Path, tmp_path: Path, episodes_root: Path) -> None:
    dataset = SourceConfig("test/episodes", str(episodes_root))
    index = report(ReportConfig(records=str(records_file), output_dir=tmp_path / "report", dataset=dataset))
    page = Page(index)
    assert len(page.anchors) == 4
    assert "test/episodes" in page.text
    assert not (tmp_path / "report" / "open_loop.png").exists()


def test_videos_beyond_the_limit_are_counted(
    records_file: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    folder = write_evaluation(tmp_path / "eval", "variation_00_success", "variation_04_failure")
    size = max(video.stat().st_size for video in folder.rglob("*.mp4"))
    monkeypatch.setattr(rollouts, "MAX_VIDEO_BYTES", size)
    index = report(
        ReportConfig(records=str(records_file), output_dir=tmp_path / "report", videos=str(folder))
    )
    page = Page(index)
    assert page.captions == ["reach-v3, wm_bc, variation 4: failure"]
    assert re.search(r"1\s+of the 2", page.text)


def test_a_success_and_a_failure_are_shown_first(records_file: Path, tmp_path: Path) -> None:
    names = [f"variation_{number:02}_{outcome}" for number in (0, 1) for outcome in ("success", "failure")]
    folder = write_evaluation(tmp_path / "eval", *names)
    index = report(
        ReportConfig(records=str(records_file), output_dir=tmp_path / "report", videos=str(folder))
    )
    page = Page(index)
    shown = [source for tag, source in page.sources if tag == "video"]
    first = [folder / "videos" / "reach-v3" / f"variation_00_{o}.mp4" for o in ("success", "failure")]
    assert shown == [data_uri(path.read_bytes(), MP4) for path in first]
    assert "reach-v3, wm_bc, variation 0: success" in page.text


def test_quality_is_included(records_file: Path, tmp_path: Path, quality_path: Path) -> None:
    config = ReportConfig(records=str(records_file), output_dir=tmp_path / "report", quality=quality_path)
    page = Page(report(config))
    assert "knowledge" in page.anchors
    assert "R²" in page.text


def test_training_seeds_get_a_table_of_their_own(
    tmp_path: Path, make_records: Callable, capsys: pytest.CaptureFixture
) -> None:
    paths = [tmp_path / "seed_0.jsonl", tmp_path / "seed_1.jsonl"]
    for seed, path in enumerate(paths):
        records = make_records("wm_bc", {"reach-v3": (4, 15 + seed)}, seed)
        path.write_text("".join(map(record_line, records)))
    index = report(ReportConfig(records=f"{tmp_path}/seed_*.jsonl", output_dir=tmp_path / "report"))
    assert "39/100" in Page(index).text
    assert "| wm_bc, seed 1 | 20/50  40 [28, 54] |" in (tmp_path / "report" / "success.md").read_text()
    assert "Each training seed" not in capsys.readouterr().out


def test_a_dataset_that_the_model_cannot_read_is_refused(
    records_file: Path, tmp_path: Path, untrained_path: Path
) -> None:
    record_stranger(tmp_path / "stranger")
    config = ReportConfig(
        records=str(records_file),
        output_dir=tmp_path / "report",
        world_model_path=str(untrained_path),
        dataset=SourceConfig("test/recorded", str(tmp_path / "stranger")),
    )
    with pytest.raises(ValueError, match="test/recorded"):
        report(config)
    assert not (tmp_path / "report").exists()


def test_inputs_that_are_not_there_are_named(records_file: Path, tmp_path: Path) -> None:
    def build(**flags: str) -> None:
        report(ReportConfig(records=str(records_file), output_dir=tmp_path / "report", **flags))

    with pytest.raises(FileNotFoundError, match=r"eval_info\.json.*--videos"):
        build(videos=str(tmp_path))
    with pytest.raises(FileNotFoundError, match=r"train_log\.jsonl.*--train_logs"):
        build(train_logs=str(tmp_path))
    with pytest.raises(FileNotFoundError, match=r"replay\.json.*--replay"):
        build(replay=tmp_path / "replay.json")
    with pytest.raises(ValueError, match=r"--world_model_path=.*--dataset\.repo_id"):
        build(world_model_path=str(tmp_path))
    assert not (tmp_path / "report").exists()
