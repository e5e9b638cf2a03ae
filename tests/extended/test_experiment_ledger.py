"""Records of the experiment: what counts as finished, and that no rollout is recorded twice."""

from dataclasses import replace
from pathlib import Path

import pytest

from lerobot_wm.experiment.experiment import Ledger
from lerobot_wm.experiment.preset import Preset, load_preset
from lerobot_wm.records import Record, read_records, record_line


@pytest.fixture
def preset() -> Preset:
    return replace(
        load_preset("smoke"), tasks="reach-v3,door-open-v3", first_eval_seed=48, rollouts_per_task=3
    )


def rollouts(arm: str, seed: int, preset: Preset, success: bool = True) -> list[Record]:
    """One on each of the variations 48, 49 and 0."""
    return [
        {
            "arm": arm,
            "policy_type": "wm_bc",
            "preset": preset.name,
            "seed": seed,
            "task": task,
            "variation": variation,
            "seen": variation < 10,
            "success": success,
            "steps": 5,
            "return": float(success),
        }
        for task in preset.task_names
        for variation in (48, 49, 0)
    ]


def write(path: Path, records: list[Record]) -> Path:
    path.parent.mkdir(parents=True, exist_ok=True)
    path.write_text("".join(map(record_line, records)))
    return path


def test_added_once_and_found_again(tmp_path: Path, preset: Preset) -> None:
    path, committed = tmp_path / "records.jsonl", tmp_path / "none.jsonl"
    ledger = Ledger(path, committed, preset)
    assert not ledger.runs
    records = rollouts("wm_bc", 0, preset)
    # One file per task, as an individual arm writes them.
    files = [write(tmp_path / "a.jsonl", records[:3]), write(tmp_path / "b.jsonl", records[3:])]
    for _ in range(2):
        ledger.add(files)
    ledger.write()
    assert read_records([path]) == records
    again = Ledger(path, committed, preset)
    assert ("wm_bc", 0) in again.runs
    assert ("wm_bc", 1) not in again.runs
    again.add([write(tmp_path / "c.jsonl", rollouts("wm_bc", 1, preset))])
    again.write()
    # read_records refuses a rollout that is there twice.
    assert len(read_records([path])) == 2 * len(records)
    assert not list(tmp_path.glob("*.part"))


def test_committed_records_count_and_take_precedence(tmp_path: Path, preset: Preset) -> None:
    path, committed = tmp_path / "records.jsonl", tmp_path / "results.jsonl"
    before = Ledger(path, committed, preset)
    for arm in ("wm_bc", "wm_iql"):
        before.add([write(tmp_path / f"{arm}.jsonl", rollouts(arm, 0, preset))])
    write(committed, rollouts("wm_bc", 0, preset, success=False))
    ledger = Ledger(path, committed, preset)
    assert ("wm_bc", 0) in ledger.runs
    assert ("wm_iql", 0) in ledger.runs
    ledger.write()
    kept = read_records([path])
    assert len(kept) == 12
    assert not any(record["success"] for record in kept if record["arm"] == "wm_bc")


def test_own_records_count_without_the_committed_ones(tmp_path: Path, preset: Preset) -> None:
    path, committed = tmp_path / "records.jsonl", tmp_path / "results.jsonl"
    write(committed, rollouts("wm_bc", 0, preset))
    ledger = Ledger(path, committed, preset)
    ledger.add([write(tmp_path / "a.jsonl", rollouts("wm_iql", 0, preset))])
    ledger.write()
    again = Ledger(path, tmp_path / "none.jsonl", preset)
    assert ("wm_bc", 0) not in again.runs
    assert ("wm_iql", 0) in again.runs


def test_an_incomplete_run_does_not_count(tmp_path: Path, preset: Preset) -> None:
    committed = write(tmp_path / "results.jsonl", rollouts("wm_bc", 0, preset)[:-1])
    ledger = Ledger(tmp_path / "records.jsonl", committed, preset)
    assert ("wm_bc", 0) not in ledger.runs
    ledger.add([write(tmp_path / "a.jsonl", rollouts("wm_bc", 0, preset))])
    ledger.write()
    assert len(read_records([tmp_path / "records.jsonl"])) == 6


def test_records_of_another_preset_do_not_count(tmp_path: Path, preset: Preset) -> None:
    records = [record | {"preset": "cpu"} for record in rollouts("wm_bc", 0, preset)]
    file = write(tmp_path / "others.jsonl", records)
    ledger = Ledger(tmp_path / "records.jsonl", file, preset)
    with pytest.raises(ValueError, match=rf"others\.jsonl.*preset {preset.name}"):
        ledger.add([file])
    assert not ledger.runs
