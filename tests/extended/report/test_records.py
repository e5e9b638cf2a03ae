"""Reading records files, and what is refused."""

import json
from collections.abc import Callable
from pathlib import Path

import pytest

from lerobot_wm.records import find_records, read_records, record_line


def test_lists_and_globs(tmp_path: Path) -> None:
    for name in ("b/records.jsonl", "a/records.jsonl", "c.jsonl"):
        (tmp_path / name).parent.mkdir(exist_ok=True)
        (tmp_path / name).touch()
    found = find_records(f"{tmp_path}/c.jsonl, {tmp_path}/*/records.jsonl,{tmp_path}/a/records.jsonl")
    assert [str(path.relative_to(tmp_path)) for path in found] == [
        "c.jsonl",
        "a/records.jsonl",
        "b/records.jsonl",
    ]
    with pytest.raises(FileNotFoundError, match="nothing"):
        find_records(f"{tmp_path}/nothing*.jsonl")


def test_a_repeated_rollout_is_refused(records_file: Path, tmp_path: Path) -> None:
    again = tmp_path / "again.jsonl"
    again.write_text(records_file.read_text().splitlines()[3] + "\n")
    with pytest.raises(ValueError, match=r"again\.jsonl:1 .*'reach-v3', 3.*records\.jsonl:4"):
        read_records([records_file, again])


def test_one_arm_under_two_presets_is_refused(make_records: Callable, tmp_path: Path) -> None:
    path = tmp_path / "records.jsonl"
    records = make_records("wm_bc", {"reach-v3": (1, 1)})
    other_seed = [r | {"seed": 1, "preset": "paper"} for r in records]
    other_arm = [r | {"arm": "best_bc", "preset": "best"} for r in records]
    path.write_text("".join(map(record_line, records + other_arm)))
    assert len(read_records([path])) == 100, "arms may differ in their presets"
    path.write_text("".join(map(record_line, records + other_seed)))
    with pytest.raises(
        ValueError, match=r"records\.jsonl:51: preset .*'wm_bc'.*'paper'.*'test'.*records\.jsonl:1\b"
    ):
        read_records([path])


def test_positions_of_different_sets_are_refused(make_records: Callable, tmp_path: Path) -> None:
    """Variation 3 of set 42 is collected on, variation 3 of set 43 is another place."""
    path = tmp_path / "records.jsonl"
    elsewhere = [record | {"seen": False} for record in make_records("e2e_bc", {"reach-v3": (1, 1)})]
    path.write_text("".join(map(record_line, make_records("wm_bc", {"reach-v3": (1, 1)}) + elsewhere)))
    with pytest.raises(
        ValueError,
        match=r"records\.jsonl:51: seen .*'reach-v3', 0.* False.* True .*:1\. .*--env\.variation_set",
    ):
        read_records([path])


def test_lines_that_are_not_records_are_named(records_file: Path) -> None:
    good = records_file.read_text().splitlines()[0]
    without_steps = json.loads(good)
    del without_steps["steps"]
    for bad in (good[:30], json.dumps(without_steps), "[]"):
        records_file.write_text(f"{good}\n{bad}\n")
        with pytest.raises(ValueError, match=r"records\.jsonl:2 .*'steps'"):
            read_records([records_file])


def test_empty_files_are_refused(tmp_path: Path) -> None:
    (tmp_path / "records.jsonl").touch()
    with pytest.raises(ValueError, match="empty"):
        read_records([tmp_path / "records.jsonl"])


def test_sets_without_seen_variations_are_not_mixed(make_records: Callable, tmp_path: Path) -> None:
    """None of sets 43 and 44 is seen; older records without a set are accepted."""
    path = tmp_path / "records.jsonl"
    unseen = [record | {"seen": False} for record in make_records("wm_bc", {"reach-v3": (1, 1)})]
    arms = {set_: [r | {"arm": f"of_{set_}", "variation_set": set_} for r in unseen] for set_ in (43, 44)}
    path.write_text("".join(map(record_line, unseen + arms[43])))
    assert len(read_records([path])) == 100
    path.write_text("".join(map(record_line, unseen + arms[43] + arms[44])))
    with pytest.raises(
        ValueError,
        match=r"records\.jsonl:101: variation_set .*'reach-v3', 0.* 44.* 43 .*:51\.",
    ):
        read_records([path])
