"""A disk that is full or read-only, and two writers of one output: one line, nothing torn, the same command goes on."""

import fcntl
import shutil
from collections.abc import Iterator
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path
from types import SimpleNamespace

import pytest
from lerobot.datasets.lerobot_dataset import LeRobotDataset
from lerobot.utils.io_utils import load_json

from lerobot_wm.data.cache import CACHE_VARIABLE, camera_frames
from lerobot_wm.data.source import open_dataset
from lerobot_wm.errors import disk_problem
from lerobot_wm.files import sole_writer
from lerobot_wm.records import read_records
from tests.extended.faults.conftest import WIDE
from tests.extended.faults.running import Commands, Inputs, remount, small_disk, wait_until

NAMES = ("collect", "encode", "train", "eval")
# The disk takes the beginning of what the command writes.
SIZES = {"collect": "40k", "encode": "60k", "eval": "16k"}
STEPS = "--steps=6"


@pytest.fixture
def disk(tmp_path: Path) -> Iterator[Path]:
    """A disk with room for everything, to be made smaller."""
    with small_disk(tmp_path / "disk", "400m") as place:
        yield place


def check_result(name: str, output: Path) -> None:
    if name in ("collect", "encode"):
        open_dataset("a/b", output)
    elif name == "eval":
        assert len(read_records([output / "records.jsonl"])) == 2
    else:
        assert (
            load_json(output / "checkpoints" / "last" / "training_state" / "training_step.json")["step"] == 6
        )


@pytest.mark.parametrize("name", SIZES)
def test_a_full_disk(name: str, processes: Commands, inputs: Inputs, disk: Path) -> None:
    remount(disk, f"size={SIZES[name]}")
    command = inputs.command(name, disk / "output")
    ended = processes.run(command)
    assert ended.code == 1, ended.printed
    assert "Traceback" not in ended.printed
    assert ended.last_line.startswith(f"lerobot-wm {name}: ")
    assert "No space left on device" in ended.last_line
    assert not (disk / "output" / "meta").exists()
    assert not (disk / "output" / "records.jsonl").exists()

    remount(disk, "size=400m")
    again = processes.run(command)
    assert again.code == 0, again.printed
    check_result(name, disk / "output")
    assert not list(disk.glob("*.part"))


@pytest.mark.slow
def test_a_disk_that_is_full_for_workers(processes: Commands, inputs: Inputs, disk: Path) -> None:
    remount(disk, "size=40k")
    command = inputs.command("collect", disk / "output", workers=2)
    ended = processes.run(command)
    assert ended.code == 1, ended.printed
    assert "Traceback" not in ended.printed
    assert "No space left on device" in ended.last_line
    assert not (disk / "output").exists()

    remount(disk, "size=400m")
    again = processes.run(command)
    assert again.code == 0, again.printed
    check_result("collect", disk / "output")


def test_a_disk_that_is_full_at_the_second_checkpoint(
    processes: Commands, inputs: Inputs, disk: Path
) -> None:
    whole = processes.run(inputs.command("train", disk / "whole"), "--steps=3")
    assert whole.code == 0, whole.printed
    size = sum(path.stat().st_size for path in (disk / "whole").rglob("*") if path.is_file())
    shutil.rmtree(disk / "whole")
    remount(disk, f"size={int(1.5 * size) // 1024}k")
    run = disk / "run"
    ended = processes.run(inputs.command("train", run), STEPS)
    assert ended.code == 1, ended.printed
    assert "Traceback" not in ended.printed
    assert (
        "No space left on device: make room there, or choose another place; then resume with"
        in ended.last_line
    )
    _, advice, _ = ended.last_line.split("`")
    assert (run / "checkpoints" / "last").resolve().name == "000003"

    remount(disk, "size=400m")
    again = processes.run(advice.removeprefix("lerobot-wm "))
    assert again.code == 0, again.printed
    check_result("train", run)


def test_no_room_for_decoded_frames(processes: Commands, inputs: Inputs, disk: Path, tmp_path: Path) -> None:
    remount(disk, "size=200k")
    command = inputs.command("train", tmp_path / "run")
    ended = processes.run(command, STEPS, **{CACHE_VARIABLE: str(disk)})
    assert ended.code == 1, ended.printed
    assert CACHE_VARIABLE in ended.last_line
    assert not (tmp_path / "run" / "checkpoints").exists()


def test_a_disk_that_fills_while_frames_are_decoded(
    dataset: Path, disk: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    remount(disk, "size=40k")
    source = LeRobotDataset("test/faults", root=dataset)
    monkeypatch.setenv(CACHE_VARIABLE, str(disk))
    monkeypatch.setattr(shutil, "disk_usage", lambda _: SimpleNamespace(free=10**9))  # a moment ago
    with pytest.raises(OSError, match="No space left on device") as found:
        camera_frames(source, WIDE)
    assert str(disk) in str(disk_problem(found.value))
    remount(disk, "size=400m")
    assert camera_frames(source, WIDE)[-1].any()


@pytest.mark.parametrize("name", NAMES)
def test_a_folder_that_cannot_be_written(name: str, processes: Commands, inputs: Inputs, disk: Path) -> None:
    remount(disk, "ro")
    ended = processes.run(inputs.command(name, disk / "output"))
    assert ended.code == 1, ended.printed
    assert "Traceback" not in ended.printed
    assert "Training:" not in ended.printed, "found out before work starts"
    assert f"{disk}/" in ended.last_line
    assert "Read-only file system" in ended.last_line


@pytest.mark.parametrize("name", NAMES)
def test_an_output_that_is_a_file(name: str, processes: Commands, inputs: Inputs, tmp_path: Path) -> None:
    (tmp_path / "output").write_text("mine")
    ended = processes.run(inputs.command(name, tmp_path / "output"))
    assert ended.code == 1, ended.printed
    assert ended.last_line.startswith(f"lerobot-wm {name}: {tmp_path / 'output'}")
    assert (tmp_path / "output").read_text() == "mine"


@pytest.mark.parametrize("name", NAMES)
def test_a_second_process(name: str, processes: Commands, inputs: Inputs, tmp_path: Path) -> None:
    output = tmp_path / "output"
    command = f"{inputs.command(name, output)}{f' {STEPS}' if name == 'train' else ''}"
    first = processes.start(command)
    # The folder of a training is there by then: it is neither gone on with nor to be removed.
    begun = output.exists if name == "train" else lambda: list(tmp_path.rglob(".*.lock"))
    wait_until(begun)
    with first.paused():
        second = processes.run(command)
    assert second.code == 1, second.printed
    assert f"lerobot-wm {name}: " in second.last_line
    assert str(output) in second.last_line
    ended = first.wait()
    assert ended.code == 0, ended.printed
    check_result(name, output)
    assert not list(tmp_path.rglob(".*.lock"))


def test_jobs_get_along_but_not_with_themselves_nor_with_the_whole(tmp_path: Path) -> None:
    output = tmp_path / "new" / "output"
    with sole_writer(output, "1-of-2"), sole_writer(output, "2-of-2"):
        for job in (None, "1-of-2"):
            with pytest.raises(BlockingIOError, match="another process is writing"), sole_writer(output, job):
                pass
    assert not list((tmp_path / "new").iterdir())
    with sole_writer(output), pytest.raises(BlockingIOError), sole_writer(output, "1-of-2"):
        pass
    assert not list((tmp_path / "new").iterdir())


def test_one_that_waits_comes_after(tmp_path: Path) -> None:
    def write(text: str) -> None:
        with sole_writer(tmp_path / "output", wait=True), (tmp_path / "output").open("a") as file:
            file.write(text)

    with ThreadPoolExecutor(4) as pool:
        with sole_writer(tmp_path / "output"):
            writers = [pool.submit(write, "x") for _ in range(4)]
            assert not (tmp_path / "output").exists()
        for writer in writers:
            writer.result(timeout=60)
    assert (tmp_path / "output").read_text() == "xxxx"
    assert [path.name for path in tmp_path.iterdir()] == ["output"]


def test_a_lock_that_its_process_left_behind_holds_nothing(tmp_path: Path) -> None:
    with (tmp_path / ".output.lock").open("w") as file:
        fcntl.flock(file, fcntl.LOCK_EX)
    with sole_writer(tmp_path / "output"):
        pass
    assert not list(tmp_path.iterdir())
