"""Which videos go on the page, and which cells of the grid they belong to."""

from collections.abc import Callable
from pathlib import Path

import pytest

from lerobot_wm.report import rollouts
from lerobot_wm.report.rollouts import Clip, make_grids, within_limit


def clip(folder: Path, arm: str, variation: int, success: bool, n_bytes: int = 10) -> Clip:
    path = folder / f"{arm}_{variation}.mp4"
    path.write_bytes(bytes(n_bytes))
    return Clip(arm, "reach-v3", variation, success, path)


def test_failures_first_and_every_arm_in_turn(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    clips = [clip(tmp_path, "wm_bc", i, success=i == 0) for i in range(4)]
    clips += [clip(tmp_path, "e2e_bc", i, success=i != 1) for i in range(4)]
    kept = [(c.arm, c.variation) for c in within_limit(clips)]
    assert kept[:4] == [("wm_bc", 1), ("e2e_bc", 1), ("wm_bc", 2), ("wm_bc", 3)]
    assert len(kept) == 8
    monkeypatch.setattr(rollouts, "MAX_VIDEO_BYTES", 45)
    assert [(c.arm, c.variation) for c in within_limit(clips)] == kept[:4]


def test_a_file_too_large_leaves_room_for_others(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(rollouts, "MAX_VIDEO_BYTES", 30)
    clips = [clip(tmp_path, "wm_bc", 0, False, n_bytes=31), clip(tmp_path, "wm_bc", 1, False)]
    assert [c.variation for c in within_limit(clips)] == [1]


def test_grid_of_rollouts(make_records: Callable, tmp_path: Path) -> None:
    records = make_records("wm_bc", {"reach-v3": (2, 5)}, seed=0) + make_records(
        "wm_bc", {"reach-v3": (1, 5)}, seed=1
    )
    records += [r for r in make_records("expert", {"reach-v3": (10, 40)}) if r["variation"] != 3]
    kept = clip(tmp_path, "wm_bc", 2, success=False)
    [grid] = make_grids(list(reversed(records)), [kept])
    assert (grid.task, grid.n_seen, grid.variations) == ("reach-v3", 10, list(range(50)))
    rows = dict(grid.rows)
    assert list(rows) == ["wm_bc", "expert"]
    assert [cell.kind for cell in rows["wm_bc"][:3]] == ["success", "mixed", "failure"]
    assert (rows["wm_bc"][1].successes, rows["wm_bc"][1].n) == (1, 2)
    assert rows["expert"][3] is None
    assert [cell.clip for cell in rows["wm_bc"][:4]] == [None, None, kept, None]
    assert all(cell is None or cell.clip is None for cell in rows["expert"]), "of another arm"


def test_seen_variations_come_first_even_with_larger_numbers(make_records: Callable) -> None:
    records = [r | {"seen": r["variation"] >= 45} for r in make_records("wm_bc", {"reach-v3": (0, 0)})]
    [grid] = make_grids(records, [])
    assert grid.variations[:6] == [45, 46, 47, 48, 49, 0]
    assert grid.n_seen == 5
