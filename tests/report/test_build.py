"""`lerobot-wm report`: from records alone, and with everything."""

import json
import re
import sys
from html.parser import HTMLParser
from pathlib import Path

import numpy as np
import pytest
from lerobot.utils.io_utils import write_video
from PIL import Image

from lerobot_wm import cli
from lerobot_wm.report.build import ReportConfig, ReportDatasetConfig, report

VOID = {"meta", "img", "br"}


class Page(HTMLParser):
    """What a page holds: its headings, sources and text; fails on tags that do not nest."""

    def __init__(self, path: Path) -> None:
        super().__init__()
        self.open, self.sources, self.headings, self.text = [], [], [], ""
        self.feed(path.read_text())
        assert not self.open

    def handle_starttag(self, tag: str, attrs: list) -> None:
        self.sources += [(tag, value) for name, value in attrs if name in ("src", "href")]
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
    assert f"{tmp_path}/report/index.html" in printed

    page = Page(tmp_path / "report" / "index.html")
    assert page.headings == ["Success", "Where this comes from"]
    assert "R&D <1>" in page.text
    assert re.search(r"100% *\[93, 100\] ·\s+50/50", page.text)
    assert "lerobot-wm report" in page.text
    assert page.sources == []
    assert (
        "| window-close-v3 | 50/50  100 [93, 100] | 47/50" in (tmp_path / "report" / "success.md").read_text()
    )
    assert not (tmp_path / "report" / "open_loop.png").exists()


def test_everything(records_file: Path, tmp_path: Path, world_model_path: Path, episodes_root: Path) -> None:
    evaluation = tmp_path / "eval"
    (evaluation / "videos" / "reach-v3").mkdir(parents=True)
    info = {"arm": "wm_bc", "provenance": {"command": "lerobot-wm eval --arm=wm_bc"}}
    (evaluation / "eval_info.json").write_text(json.dumps(info))
    video = evaluation / "videos" / "reach-v3" / "variation_03_failure.mp4"
    write_video(video, [np.full((64, 64, 3), 10 * i, np.uint8) for i in range(8)], fps=80)
    run = tmp_path / "world_model"
    run.mkdir()
    entries = [
        {"step": step, "steps": step, "loss": 1 / step, "kl": 3.0, "update_s": 0.1} for step in (1, 2, 3)
    ]
    (run / "train_log.jsonl").write_text("".join(json.dumps(entry) + "\n" for entry in entries))

    index = report(
        ReportConfig(
            records=str(records_file),
            output_dir=tmp_path / "report",
            videos=str(evaluation),
            train_logs=str(run),
            world_model_path=str(world_model_path),
            dataset=ReportDatasetConfig("test/episodes", str(episodes_root)),
        )
    )
    page = Page(index)
    assert page.headings == [
        "Success",
        "Rollouts",
        "Open-loop prediction",
        "Training",
        "Where this comes from",
    ]
    kinds = [(tag, source.split(";")[0]) for tag, source in page.sources]
    assert kinds == [
        ("video", "data:video/mp4"),
        ("img", "data:image/png"),
        ("img", "data:image/svg+xml"),  # kl
        ("img", "data:image/svg+xml"),  # loss
    ], "everything is in the page, and nothing else is loaded"
    assert re.search(r"wm_bc\s*variation 3 · failure", page.text)
    assert "lerobot-wm eval --arm=wm_bc" in page.text
    with Image.open(tmp_path / "report" / "open_loop.png") as picture:
        assert picture.width > 600


def test_inputs_that_are_not_there_are_named(records_file: Path, tmp_path: Path) -> None:
    def build(**flags: str) -> None:
        report(ReportConfig(records=str(records_file), output_dir=tmp_path / "report", **flags))

    with pytest.raises(FileNotFoundError, match=r"eval_info\.json is missing: --videos"):
        build(videos=str(tmp_path))
    with pytest.raises(FileNotFoundError, match=r"train_log\.jsonl is missing: --train_logs"):
        build(train_logs=str(tmp_path))
    with pytest.raises(ValueError, match="both --world_model_path and"):
        build(world_model_path=str(tmp_path))
    assert not (tmp_path / "report").exists()
