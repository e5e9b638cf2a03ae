"""The pages of results/ show the committed rollouts and measurements."""

import json
import re
import runpy
from pathlib import Path
from typing import Any

import numpy as np
import pyarrow.parquet as pq
import pytest

from lerobot_wm.envs.tasks import resolve_tasks
from lerobot_wm.records import read_records
from lerobot_wm.report.command import ReportConfig, report
from lerobot_wm.statistics import in_split, success_rate

ROOT = Path(__file__).resolve().parents[1]
TASKS = sorted(resolve_tasks("mt6"))  # the order of the columns


def read_page(page: str) -> str:
    return (ROOT / "results" / page).read_text()


def rows(text: str, header: str) -> list[list[str]]:
    """The cells of the table whose header begins so, without backticks, row by row."""
    [_, after] = text.split(f"\n{header}")
    lines = after.split("\n\n")[0].splitlines()[2:]
    return [[cell.strip(" `") for cell in line.split("|")[1:-1]] for line in lines]


def trials(preset: str) -> dict[str, list[dict[str, Any]]]:
    """The rollouts of a preset's trials, by the trial's name."""
    found: dict[str, list[dict[str, Any]]] = {}
    for rollout in pq.read_table(ROOT / "results" / preset / "trials.parquet").to_pylist():
        found.setdefault(rollout["trial"], []).append(rollout)
    return found


def test_success_of_cpu_is_that_of_the_rollouts() -> None:
    records = read_records([ROOT / "results" / "cpu" / "records.jsonl.gz"])
    table = rows(read_page("cpu/README.md"), "| arm | what it is |")
    assert {arm for arm, *_ in table} == {record["arm"] for record in records}
    for arm, _, *cells in table:
        of_arm = [record for record in records if record["arm"] == arm]
        splits = [success_rate(r for r in of_arm if in_split(r, split)) for split in ("seen", "unseen")]
        n_seeds = len({record["seed"] for record in of_arm})
        assert cells == [str(n_seeds), *map(str, splits), str(success_rate(of_arm))], arm


@pytest.mark.parametrize(("heading", "name"), [("set 44", "records_set44"), ("set 42", "records")])
def test_success_of_best_is_that_of_the_rollouts(heading: str, name: str) -> None:
    records = read_records([ROOT / "results" / "best" / f"{name}.jsonl.gz"])
    section = read_page("best/README.md").split(f"## Success on {heading}\n")[1].split("\n## ")[0]
    table = rows(section, "| arm | button-press |")
    assert {arm for arm, *_ in table} == {record["arm"] for record in records}
    for arm, *cells in table:
        of_arm = [record for record in records if record["arm"] == arm]
        rates = [success_rate(r for r in of_arm if r["task"] == task) for task in TASKS]
        unseen = str(success_rate(r for r in of_arm if in_split(r, "unseen"))).split("  ")[1]
        expected = [*(f"{rate.percent:.0f}" for rate in rates if rate), unseen, str(success_rate(of_arm))]
        assert cells == expected, arm


@pytest.mark.parametrize("preset", ["cpu", "best"])
def test_pages_of_trials_show_their_rollouts(preset: str) -> None:
    """A table's row that names a trial and counts successes, such as `44/50`, counts those of one of its arms."""
    page = read_page(f"{preset}/trials.md")
    n_compared = 0
    for name, rollouts in trials(preset).items():
        assert f"`{name}`" in page
        counts = set()
        for arm in {rollout["arm"] for rollout in rollouts}:
            for task in (None, "reach-v3"):
                of_arm = [r["success"] for r in rollouts if r["arm"] == arm and task in (None, r["task"])]
                counts.add(f"{sum(of_arm)}/{len(of_arm)}")
        for line in page.splitlines():
            if line.startswith("|") and f"`{name}`" in line:
                shown = set(re.findall(r"\d+/\d+", line))
                assert shown <= counts, (name, line)
                n_compared += len(shown)
    assert n_compared >= 4


def test_earlier_table_of_cpu_is_that_of_its_rollouts() -> None:
    rollouts = trials("cpu")["constant_rate"]
    for arm, n_seeds, everything, per_seed in rows(read_page("cpu/trials.md"), "| arm | seeds | all |"):
        of_arm = [rollout for rollout in rollouts if rollout["arm"] == arm]
        seeds = sorted({rollout["seed"] for rollout in of_arm})
        assert (n_seeds, everything) == (str(len(seeds)), str(success_rate(of_arm))), arm
        if per_seed:
            counts = [sum(r["success"] for r in of_arm if r["seed"] == seed) for seed in seeds]
            assert per_seed == ", ".join(map(str, counts)), arm


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
    """To fix: `lerobot-wm report --records=results/PRESET/RECORDS`, and commit its success.md."""
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
    measured = json.loads(read_page(f"{preset}/quality.json"))["open_loop"]
    table = rows(read_page(f"{preset}/README.md"), "| PSNR in dB, mean of six tasks |")
    expected = {}
    for prediction, name in names.items():
        by_horizon: dict[int, list[float]] = {}
        for entry in measured:
            if entry["prediction"] == prediction and entry["task"] != "all tasks":
                by_horizon.setdefault(entry["horizon"], []).append(entry["psnr"])
        expected[name] = [f"{np.mean(psnr):.1f}" for psnr in by_horizon.values()]
    assert {name: cells for name, *cells in table} == expected


def test_the_rates_of_mt10_are_those_of_the_committed_rollouts() -> None:
    records = read_records([ROOT / "results" / "mt10" / "records.jsonl.gz"])
    arms = ("wm_iql", "wm_bc", "proprio_bc", "expert")
    header = f"| task | {' | '.join(f'`{arm}`' for arm in arms)} |"
    table = rows(read_page("mt10/README.md"), header)
    assert {task for task, *_ in table} >= set(resolve_tasks("mt10"))
    for task, *cells in table:
        for arm, cell in zip(arms, cells, strict=True):
            chosen = [r for r in records if r["arm"] == arm]
            if task in resolve_tasks("mt10"):
                chosen = [r for r in chosen if r["task"] == task]
            elif task != "all":
                chosen = [r for r in chosen if in_split(r, task.split()[2])]
            assert cell == str(success_rate(chosen)), (task, arm)


def test_the_page_of_benchmarks_shows_the_measured_memory() -> None:
    peak, warm, cold = json.loads(read_page("benchmarks/memory.json"))["rows"]
    page = read_page("benchmarks/README.md").split("\n## Memory\n")[1]
    assert f"| {peak['ours']:.1f} GB | bound, the frames and 2.5 GB: {peak['peer']:.1f} GB |" in page
    assert f"memory of the process alone | {peak['private']:.1f} GB |" in page
    for row, side, key in ((warm, "warm", "ours"), (warm, "RAM", "peer"), (cold, "cold", "ours")):
        speeds = row["repeats"][side]
        assert f"{row[key]:,.0f} [{speeds[0]:,}, {speeds[-1]:,}]" in page


def test_precision_page_shows_the_committed_runs_and_rollouts() -> None:
    folder = ROOT / "results" / "precision"
    script = runpy.run_path(str(folder / "compare_precision.py"))
    document = json.loads((folder / "precision.json").read_text())
    half = [rollout for rollout in trials("cpu")["constant_rate"] if rollout["seed"] == 0]
    assert script["success"](half, read_records([folder / "records_float32.jsonl.gz"])) == document["success"]
    page = (folder / "README.md").read_text()
    assert all(table in page for table in script["tables"](document).split("\n\n"))
