"""The cores that work is spread over."""

import os
from pathlib import Path

import pytest

from lerobot_wm import system as cores
from lerobot_wm.system import usable_cores


@pytest.mark.skipif(not hasattr(os, "sched_setaffinity"), reason="the system does not pin processes to cores")
def test_cores_are_those_the_process_is_pinned_to(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(cores, "_OWN_CGROUP", tmp_path / "none")  # tests may run in a container with a limit
    allowed = os.sched_getaffinity(0)
    try:
        os.sched_setaffinity(0, {min(allowed)})
        assert usable_cores() == 1
    finally:
        os.sched_setaffinity(0, allowed)
    assert usable_cores() == len(allowed)


@pytest.mark.parametrize(
    ("group", "limits", "expected"),
    [
        ("/", {".": "max 100000"}, 64),
        ("/", {".": "250000 100000"}, 3),
        ("/", {".": "20000 100000"}, 1),
        ("/slice/job", {"slice": "400000 100000", "slice/job": "max 100000"}, 4),
        ("/docker/gone", {".": "200000 100000"}, 2),
        ("/job", {"job": "9900000 100000"}, 64),
    ],
)
def test_a_limit_of_time_is_a_limit_of_cores(
    group: str, limits: dict[str, str], expected: int, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """As containers and batch jobs have it, whose processes may run on all cores, each some of the time."""
    for folder, limit in limits.items():
        (tmp_path / "groups" / folder).mkdir(parents=True, exist_ok=True)
        (tmp_path / "groups" / folder / "cpu.max").write_text(f"{limit}\n")
    (tmp_path / "own").write_text(f"4:memory:/elsewhere\n0::{group}\n")
    monkeypatch.setattr(cores, "_CGROUPS", tmp_path / "groups")
    monkeypatch.setattr(cores, "_OWN_CGROUP", tmp_path / "own")
    monkeypatch.setattr(os, "sched_getaffinity", lambda _: set(range(64)), raising=False)
    assert usable_cores() == expected
