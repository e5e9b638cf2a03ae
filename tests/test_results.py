"""The success rates that README.md shows are those of the committed rollouts, its speeds those measured."""

import json
import runpy
from pathlib import Path

import numpy as np
import pyarrow.parquet as pq
import pytest

from lerobot_wm.envs.tasks import resolve_tasks
from lerobot_wm.records import Record, read_records
from lerobot_wm.report.command import ReportConfig, report
from lerobot_wm.statistics import in_split, success_rate

ROOT = Path(__file__).resolve().parents[1]
TASKS = sorted(resolve_tasks("mt6"))  # the order of the columns


def trial(preset: str, name: str) -> list[dict]:
    """The rollouts of one trial of a preset."""
    path = ROOT / "results" / preset / "trials.parquet"
    return pq.read_table(path, filters=[("trial", "==", name)]).to_pylist()


def shown(preset: str) -> dict[str, list[str]]:
    """The cells of the preset's table, by arm: six tasks, unseen, all."""
    text = (ROOT / "README.md").read_text()
    section = text.split(f"**Preset `{preset}`**")[1].split("\n| arm ")[1]
    rows = [line.split("|")[1:-1] for line in section.split("\n\n")[0].splitlines() if line.startswith("| `")]
    return {row[0].strip(" `"): [cell.strip() for cell in row[2:]] for row in rows}


def expected(records: list[Record]) -> list[str]:
    rates = [success_rate(r for r in records if r["task"] == task) for task in TASKS]
    unseen = success_rate(r for r in records if in_split(r, "unseen"))
    return [
        *(f"{rate.percent:.0f}" for rate in rates if rate),
        str(unseen).split("  ")[1],
        str(success_rate(records)),
    ]


@pytest.mark.parametrize(
    ("preset", "name"), [("cpu", "records.jsonl.gz"), ("best", "records_set44.jsonl.gz")]
)
def test_readme_shows_the_committed_rollouts(preset: str, name: str) -> None:
    records = read_records([ROOT / "results" / preset / name])
    table = shown(preset)
    assert table
    for arm, cells in table.items():
        assert cells == expected([record for record in records if record["arm"] == arm]), arm


@pytest.mark.parametrize(
    ("preset", "records", "tables"),
    [
        ("cpu", "records.jsonl.gz", "success.md"),
        ("best", "records.jsonl.gz", "success.md"),
        ("best", "records_set44.jsonl.gz", "success_set44.md"),
        ("mt10", "records.jsonl.gz", "success.md"),
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
    records = read_records([ROOT / "results" / "mt10" / "records.jsonl.gz"])
    readme = (ROOT / "README.md").read_text().split("**MT10**")[1].split("\n\n")[0].replace("%", "")
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
    for arm in ("wm_iql", "wm_bc"):
        assert f"`{arm}` {success_rate(r for r in records if r['arm'] == arm)}" in readme


def test_readme_shows_the_committed_measurements() -> None:
    """Peer, ours, peer's, ratio, and the ratio of the same row without bfloat16."""

    def cells(line: str) -> list[str]:
        return [cell.strip() for cell in line.split("|")[1:-1]]

    def table(name: str) -> list[list[str]]:
        lines = (ROOT / "results" / "benchmarks" / name).read_text().splitlines()
        return [cells(line) for line in lines[2:]]

    # Environment steps were measured there with all of the robot drawn.
    without = {
        tuple(row[:3]): row[-1]
        for row in table("cpu2_float32.md")
        if not row[0].startswith("environment steps")
    }
    measured = {(*row[2:], without.get(tuple(row[:3]), "")) for row in table("cpu2.md")}
    section = (ROOT / "README.md").read_text().split("\n## Speed\n")[1].split("\n## ")[0]
    *_, evaluation = [row for row in table("cpu2_float32.md") if row[2] == "lerobot-eval, metaworld"]
    ours, theirs = (cell.split()[0] for cell in evaluation[3:5])
    assert f"made {ours} rollouts of 500 steps a minute" in section
    assert f"Meta-World environment {theirs}: {evaluation[5]} times as many" in section
    shown = [tuple(cells(line)[1:]) for line in section.splitlines() if line.startswith("|")][2:]
    assert len(shown) > 10
    assert set(shown) <= measured


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
    folder = ROOT / "results" / "precision"
    script = runpy.run_path(str(folder / "compare_precision.py"))
    document = json.loads((folder / "precision.json").read_text())
    half = [record for record in trial("cpu", "constant_rate") if record["seed"] == 0]
    assert script["success"](half, read_records([folder / "records_float32.jsonl.gz"])) == document["success"]
    page = (folder / "README.md").read_text()
    assert all(table in page for table in script["tables"](document).split("\n\n"))
