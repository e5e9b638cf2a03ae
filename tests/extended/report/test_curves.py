"""Training curves: which runs share a line's colour and name."""

import json
from pathlib import Path

import pytest

from lerobot_wm.inspect.pictures import SVG, figure_bytes
from lerobot_wm.report.training import curve_figures, read_logs


def write_log(run: Path, **values: float) -> Path:
    run.mkdir(parents=True)
    timings = {"update_s": 0.1, "preprocessing_s": 0.1, "step_s": 0.2, "samples_per_s": 50}
    lines = [{"step": step} | timings | values for step in (100, 200)]
    (run / "train_log.jsonl").write_text("".join(json.dumps(line) + "\n" for line in lines))
    return run


def test_seeds_of_an_arm_do_not_hide_each_other(tmp_path: Path) -> None:
    runs = [write_log(tmp_path / f"seed_{seed}" / arm, loss=seed) for seed in (0, 1) for arm in ("a", "b")]
    logs = read_logs(runs)
    assert list(logs) == ["seed_0/a", "seed_0/b", "seed_1/a", "seed_1/b"]
    [figure] = curve_figures(logs)
    lines = figure.axes[0].lines
    assert [line.get_ydata()[0] for line in lines] == [0, 1, 0, 1], "seed by seed of a, then of b"
    assert lines[0].get_color() == lines[1].get_color() != lines[2].get_color()
    assert [text.get_text() for text in figure.legends[0].texts] == ["a", "b"]


def test_one_run_needs_no_legend(tmp_path: Path) -> None:
    logs = read_logs([write_log(tmp_path / "wm_rssm", loss=1, kl=3)])
    figures = curve_figures(logs)
    assert [figure.axes[0].get_title() for figure in figures] == ["kl", "loss"]
    assert not figures[0].legends


def test_steps_that_were_trained_again_are_drawn_once(tmp_path: Path) -> None:
    run = write_log(tmp_path / "wm_rssm")
    entries = [
        {"step": step, "loss": loss} for step, loss in ((1, 5), (2, 4), (3, 3), (2, 6), (3, 7), (4, 8))
    ]
    (run / "train_log.jsonl").write_text("".join(json.dumps(entry) + "\n" for entry in entries))
    assert read_logs([run])["wm_rssm"] == {"loss": [(1, 5), (2, 6), (3, 7), (4, 8)]}


def test_runs_may_be_given_by_absolute_and_relative_paths(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    write_log(tmp_path / "a", loss=1)
    write_log(tmp_path / "b", loss=2)
    monkeypatch.chdir(tmp_path)
    assert list(read_logs([tmp_path / "a", Path("b")])) == ["a", "b"]


def test_no_runs_have_no_curves() -> None:
    assert curve_figures(read_logs([])) == []


def test_numbers_of_a_logarithmic_axis_can_be_read(tmp_path: Path) -> None:
    """Names may contain $, so no text in a figure is typeset as mathematics."""
    run = write_log(tmp_path / "wm_rssm")
    entries = [{"step": step, "loss": loss} for step, loss in ((1, 500), (2, 1.5))]
    (run / "train_log.jsonl").write_text("".join(json.dumps(entry) + "\n" for entry in entries))
    [figure] = curve_figures(read_logs([run]))
    figure_bytes(figure, SVG)
    labels = [label.get_text() for label in figure.axes[0].get_yticklabels()]
    assert "100" in labels
    assert not any("$" in label for label in labels)
