"""The success rates that README.md shows are those of the committed rollouts, its speeds those measured."""

from pathlib import Path

import pytest

from lerobot_wm.envs.tasks import resolve_tasks
from lerobot_wm.report.records import Record, read_records
from lerobot_wm.report.statistics import in_split, success_rate

ROOT = Path(__file__).resolve().parents[1]
TASKS = sorted(resolve_tasks("mt6"))  # the order of the columns


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


@pytest.mark.parametrize("preset", ["cpu", "best"])
def test_readme_shows_the_committed_rollouts(preset: str) -> None:
    records = read_records([ROOT / "results" / preset / "records.jsonl"])
    table = shown(preset)
    assert table
    for arm, cells in table.items():
        assert cells == expected([record for record in records if record["arm"] == arm]), arm


def test_readme_shows_the_committed_measurements() -> None:
    """Peer, ours, peer's, ratio: the cells of a line are those of one line of the whole table."""

    def cells(line: str) -> list[str]:
        return [cell.strip() for cell in line.split("|")[1:-1]]

    whole = (ROOT / "results" / "benchmarks" / "cpu2.md").read_text().splitlines()[2:]
    measured = {tuple(cells(line)[2:]) for line in whole}
    section = (ROOT / "README.md").read_text().split("\n## Speed\n")[1].split("\n## ")[0]
    shown = [tuple(cells(line)[1:]) for line in section.splitlines() if line.startswith("|")][2:]
    assert len(shown) > 10
    assert set(shown) <= measured
