"""Stages of the experiment as real subprocesses: order, failure, stopping and resuming."""

import io
import json
import os
import re
import signal
import subprocess
import sys
import time
from collections.abc import Callable
from pathlib import Path
from typing import Any

import pytest
from rich.console import Console

from lerobot_wm.experiment.runner import Runner, Times, minutes_left, ranks
from lerobot_wm.experiment.stage import Stage, in_order, unfinished
from lerobot_wm.files import sole_writer

WRITE = "import os, pathlib, sys; f = pathlib.Path(sys.argv[1]); f.mkdir(parents=True)"
DONE = f"{WRITE}; (f / 'done').write_text(' '.join(sys.argv[2:]) + '|' + os.environ['OMP_NUM_THREADS'])"


def stage(
    folder: Path, name: str, *needs: Stage, code: str = DONE, kind: str = "kind", **fields: object
) -> Stage:
    place = folder / name
    return Stage(
        name=name,
        kind=kind,
        argv=(sys.executable, "-c", code, str(place)),
        folder=place,
        artefact=place / "done",
        needs=needs,
        **fields,
    )


class Shown:
    """What a run did: stages started and finished, in order."""

    def __init__(self, printed: str, finished: list[str]) -> None:
        self.started = re.findall(r"^(\S+) (?:starts|resumes);", printed, re.MULTILINE)
        self.finished = finished


def run(
    folder: Path,
    targets: list[Stage],
    processes: int = 2,
    cores: int = 2,
    minutes: dict[str, float] | None = None,
) -> tuple[Shown, list[str]]:
    """Run what is unfinished; returns what was seen and the names of the stages that failed."""
    times = Times(folder / "times.json", minutes or {"kind": 1.0})
    console, finished = Console(file=io.StringIO(), width=200), []
    runner = Runner(
        unfinished(targets), processes, cores, times, console, lambda stage: finished.append(stage.name)
    )
    with sole_writer(folder) as lock:
        failed = runner.run(lock)
    return Shown(console.file.getvalue(), finished), [stage.name for stage in failed]


def wait_until(condition: Callable[[], object], seconds: float = 240.0) -> None:
    end = time.monotonic() + seconds
    while not condition():
        assert time.monotonic() < end, "timed out"
        time.sleep(0.02)


def test_stages_run_after_those_they_need_and_never_again(tmp_path: Path) -> None:
    a = stage(tmp_path, "a")
    # b and c refuse to start without a's artefact.
    needs_a = f"assert open({str(a.artefact)!r}); {DONE}"
    b, c = (stage(tmp_path, name, a, code=needs_a) for name in "bc")
    d = stage(tmp_path, "d", b, c)
    shown, failed = run(tmp_path, [d, b])
    assert failed == []
    assert shown.started[0] == "a"
    assert shown.started[-1] == "d"
    assert sorted(shown.finished) == list("abcd")
    assert set(json.loads((tmp_path / "times.json").read_text())) == set("abcd")

    shown, failed = run(tmp_path, [d, b])
    assert shown.started == failed == []


def test_what_a_finished_stage_needed_may_be_gone(tmp_path: Path) -> None:
    a = stage(tmp_path, "a")
    b = stage(tmp_path, "b", a)
    b.folder.mkdir()
    b.artefact.write_text("")
    c = stage(tmp_path, "c", b)
    assert list(unfinished([c])) == ["c"]
    assert list(in_order([c])) == ["a", "b", "c"]


def test_a_failure_stops_only_what_needs_it(tmp_path: Path) -> None:
    bad = stage(tmp_path, "bad", code="import sys; print('the reason'); sys.exit(3)")
    silent = stage(tmp_path, "silent", code=WRITE)  # succeeds without its artefact
    lost = stage(tmp_path, "lost", stage(tmp_path, "between", bad))
    good = stage(tmp_path, "good", stage(tmp_path, "first"))
    shown, failed = run(tmp_path, [lost, silent, good], processes=1)
    assert sorted(failed) == ["bad", "silent"]
    assert sorted(shown.finished) == ["first", "good"]
    assert "the reason" in bad.log.read_text()
    assert not {"between", "lost"} & set(shown.started)


def test_an_unfinished_folder_without_a_checkpoint_is_removed(tmp_path: Path) -> None:
    a = stage(tmp_path, "a")  # its mkdir fails if the folder exists
    a.folder.mkdir()
    (a.folder / "half").write_text("")
    assert run(tmp_path, [a])[1] == []
    assert not (a.folder / "half").exists()


def test_a_stopped_stage_resumes_from_its_checkpoint(tmp_path: Path) -> None:
    place = tmp_path / "a"
    a = stage(
        tmp_path,
        "a",
        code="import sys; sys.exit('started from the beginning')",
        checkpoint=place / "checkpoint",
        resume_argv=(sys.executable, "-c", f"open({str(place / 'done')!r}, 'w').close()"),
    )
    place.mkdir()
    (place / "checkpoint").write_text("step 5")
    assert run(tmp_path, [a])[1] == []
    assert (place / "checkpoint").read_text() == "step 5"


def test_the_time_of_a_resumed_stage_is_not_recorded(tmp_path: Path) -> None:
    # A collection resumes from its shards with the same command.
    whole, rest = (
        stage(tmp_path, name, checkpoint=tmp_path / f"{name}.shards") for name in ("whole", "rest")
    )
    (tmp_path / "rest.shards").mkdir()
    assert run(tmp_path, [whole, rest])[1] == []
    assert set(json.loads((tmp_path / "times.json").read_text())) == {"whole"}


def test_the_longest_chain_starts_first(tmp_path: Path) -> None:
    short = [stage(tmp_path, f"short{i}") for i in range(2)]
    long = stage(tmp_path, "long", stage(tmp_path, "start_of_long"), kind="slow")
    shown, _ = run(tmp_path, [*short, long], processes=1, minutes={"kind": 1.0, "slow": 10.0})
    assert shown.started == ["start_of_long", "long", "short0", "short1"]


def test_stages_share_the_cores(tmp_path: Path) -> None:
    alone = stage(tmp_path, "alone", takes_workers=True)
    beside = [stage(tmp_path, f"beside{i}", alone) for i in range(3)]
    run(tmp_path, beside, processes=2, cores=8)
    assert alone.artefact.read_text() == "--num_workers=8|8"
    assert {other.artefact.read_text() for other in beside[:2]} == {"|4"}


def test_longest_chain_and_bound_of_the_time_left(tmp_path: Path) -> None:
    a = stage(tmp_path, "a")
    b, c = stage(tmp_path, "b", a), stage(tmp_path, "c", a)
    stages = in_order([b, c])
    minutes = {"a": 1.0, "b": 2.0, "c": 5.0}
    assert ranks(stages, minutes) == {"a": 6.0, "b": 2.0, "c": 5.0}
    assert minutes_left(stages, minutes, processes=8) == 6.0
    assert minutes_left(stages, minutes, processes=1) == 8.0


def test_measured_minutes_replace_the_stated_ones(tmp_path: Path) -> None:
    times = Times(tmp_path / "times.json", {"kind": 7.0})
    assert times.minutes("kind") == 7.0
    times.record(stage(tmp_path, "a"), 60.0)
    times.record(stage(tmp_path, "b"), 180.0)
    assert Times(tmp_path / "times.json", {"kind": 7.0}).minutes("kind") == 2.0


def test_arms_that_a_preset_does_not_name_take_as_long_as_its_others(tmp_path: Path) -> None:
    times = Times(tmp_path / "times.json", {"kind": 7.0, "other": 1.0})
    assert times.minutes("further") == 4.0


# A run of two long stages, as a program of its own: `python -c RUN FOLDER`.
RUN = """
import signal, sys
from pathlib import Path
from rich.console import Console
from lerobot_wm.experiment.runner import Runner, Times
from lerobot_wm.experiment.stage import Stage
from lerobot_wm.files import sole_writer
for number in (signal.SIGINT, signal.SIGTERM):  # a shell lets its background jobs ignore SIGINT
    signal.signal(number, signal.default_int_handler)
folder = Path(sys.argv[1])
SLEEP = "import os, pathlib, sys, time; pathlib.Path(sys.argv[1]).write_text(str(os.getpid())); time.sleep(600)"
stages = {}
for name in "ab":
    argv = (sys.executable, "-c", SLEEP, str(folder / f"{name}.pid"))
    stages[name] = Stage(name, "kind", argv, folder / name, folder / name / "done")
times = Times(folder / "times.json", {"kind": 1.0})
with sole_writer(folder) as lock:
    Runner(stages, 2, 2, times, Console(), on_finish=print).run(lock)
"""


def start_long_run(folder: Path) -> tuple[subprocess.Popen, list[int]]:
    """The run and the process ids of its two stages."""
    process = subprocess.Popen(
        [sys.executable, "-c", RUN, str(folder)], stdout=subprocess.DEVNULL, stderr=subprocess.DEVNULL
    )
    files = [folder / f"{name}.pid" for name in "ab"]
    wait_until(
        lambda: all(file.exists() and file.read_text() for file in files) or process.poll() is not None
    )
    assert process.poll() is None
    return process, [int(file.read_text()) for file in files]


def alive(pid: int) -> bool:
    try:
        os.kill(pid, 0)
    except ProcessLookupError:
        return False
    return True


@pytest.mark.parametrize("number", [signal.SIGINT, signal.SIGTERM])
def test_stopping_a_run_ends_its_stages(tmp_path: Path, number: signal.Signals) -> None:
    process, pids = start_long_run(tmp_path)
    process.send_signal(number)
    process.wait(30)
    assert not any(map(alive, pids))
    with sole_writer(tmp_path):
        pass


@pytest.mark.parametrize("number", [signal.SIGINT, signal.SIGTERM])
def test_a_stage_that_starts_while_the_run_is_stopped_ends_with_it(
    number: signal.Signals, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """The signal arrives between the start of its process and the registration of it."""
    started = []

    class Interrupted(subprocess.Popen):
        def __init__(self, *args: Any, **kwargs: Any) -> None:
            super().__init__(*args, **kwargs)
            started.append(self.pid)
            os.kill(os.getpid(), number)

    monkeypatch.setattr(subprocess, "Popen", Interrupted)
    before = [signal.signal(n, signal.default_int_handler) for n in (signal.SIGINT, signal.SIGTERM)]
    try:
        with pytest.raises(KeyboardInterrupt):
            run(tmp_path, [stage(tmp_path, "long", code="import time; time.sleep(600)")])
        assert signal.getsignal(number) is signal.default_int_handler
    finally:
        for n, handler in zip((signal.SIGINT, signal.SIGTERM), before, strict=True):
            signal.signal(n, handler)
    assert len(started) == 1
    assert not alive(started[0])


def test_stages_that_outlive_a_killed_run_keep_the_folder_locked(tmp_path: Path) -> None:
    process, pids = start_long_run(tmp_path)
    process.kill()
    process.wait()
    with pytest.raises(BlockingIOError, match=str(tmp_path)), sole_writer(tmp_path):
        pass
    for pid in pids:
        os.kill(pid, signal.SIGKILL)
    wait_until(lambda: not any(map(alive, pids)))
    with sole_writer(tmp_path):
        pass
