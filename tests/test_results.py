"""The pages of results/ show the committed rollouts and measurements."""

import json
import runpy
from pathlib import Path

import numpy as np
import pytest

from lerobot_wm.envs.tasks import resolve_tasks
from lerobot_wm.records import read_records
from lerobot_wm.report.command import ReportConfig, report
from lerobot_wm.statistics import in_split, success_rate

ROOT = Path(__file__).resolve().parents[1]
RATE_BEFORE = ROOT / "results" / "cpu" / "constant_rate"  # float32 was compared with these rollouts


@pytest.mark.parametrize(
    ("preset", "records", "tables"),
    [
        ("cpu", "records.jsonl", "success.md"),
        ("cpu/constant_rate", "records.jsonl", "success.md"),
        ("best", "records.jsonl", "success.md"),
        ("best", "records_set44.jsonl", "success_set44.md"),
        ("mt10", "records.jsonl", "success.md"),
    ],
)
def test_the_tables_are_those_of_the_committed_rollouts(
    preset: str, records: str, tables: str, tmp_path: Path
) -> None:
    """To mend: `lerobot-wm report --records=results/PRESET/RECORDS`, and commit its success.md."""
    folder = ROOT / "results" / preset
    report(ReportConfig(records=str(folder / records), output_dir=tmp_path))
    assert (folder / tables).read_text() == (tmp_path / "success.md").read_text()


@pytest.mark.parametrize("preset", ["cpu", "best"])
def test_the_pages_show_the_measured_quality(preset: str) -> None:
    """Means over tasks, without the row of all tasks together."""
    names = {
        "closed loop": "reconstruction (closed loop)",
        "open loop": "imagination (open loop)",
        "shuffled actions": "imagination with shuffled actions",
        "copy last frame": "last image copied",
        "mean image": "mean image",
    }
    folder = ROOT / "results" / preset
    measured = json.loads((folder / "quality.json").read_text())["open_loop"]
    page = (folder / "README.md").read_text().split("| PSNR in dB, mean of six tasks")[1].split("\n\n")[0]
    shown = {}
    for line in page.splitlines()[2:]:
        name, *cells = (cell.strip() for cell in line.split("|")[1:-1])
        shown[name] = cells
    expected = {}
    for prediction, name in names.items():
        by_horizon: dict[int, list[float]] = {}
        for entry in measured:
            if entry["prediction"] == prediction and entry["task"] != "all tasks":
                by_horizon.setdefault(entry["horizon"], []).append(entry["psnr"])
        expected[name] = [f"{np.mean(psnr):.1f}" for psnr in by_horizon.values()]
    assert shown == expected


def test_the_rates_of_mt10_are_those_of_the_committed_rollouts() -> None:
    records = read_records([ROOT / "results" / "mt10" / "records.jsonl"])
    page = (ROOT / "results" / "mt10" / "README.md").read_text().split("| task |")[1].split("\n\n")[0]
    arms = [cell.strip(" `") for cell in page.splitlines()[0].split("|")[:-1]]
    rows = [[cell.strip() for cell in line.split("|")[1:-1]] for line in page.splitlines()[2:]]
    assert {task for task, *_ in rows} >= set(resolve_tasks("mt10"))
    for task, *cells in rows:
        for arm, cell in zip(arms, cells, strict=True):
            chosen = [r for r in records if r["arm"] == arm]
            if task in resolve_tasks("mt10"):
                chosen = [r for r in chosen if r["task"] == task]
            elif task != "all":
                chosen = [r for r in chosen if in_split(r, task.split()[2])]
            assert cell == str(success_rate(chosen)), (task, arm)


def test_the_page_of_benchmarks_shows_the_measured_memory() -> None:
    folder = ROOT / "results" / "benchmarks"
    peak, warm, cold = json.loads((folder / "memory.json").read_text())["rows"]
    page = (folder / "README.md").read_text().split("## Memory")[1]
    assert f"| {peak['ours']:.1f} GB | at most the frames and 2.5 GB: {peak['peer']:.1f} GB |" in page
    assert f"the process has {peak['private']:.1f} GB to itself" in page
    for row, side, key in ((warm, "warm", "ours"), (warm, "RAM", "peer"), (cold, "cold", "ours")):
        speeds = row["repeats"][side]
        assert f"{row[key]:,.0f} [{speeds[0]:,}, {speeds[-1]:,}]" in page


def test_precision_page_shows_the_committed_trainings_and_rollouts() -> None:
    script = runpy.run_path(str(ROOT / "scripts" / "compare_precision.py"))
    folder = ROOT / "results" / "precision"
    document = json.loads((folder / "precision.json").read_text())
    half = [r for r in read_records([RATE_BEFORE / "records.jsonl"]) if r["seed"] == 0]
    assert script["success"](half, read_records([folder / "records_float32.jsonl"])) == document["success"]
    page = (folder / "README.md").read_text()
    assert all(table in page for table in script["tables"](document).split("\n\n"))
