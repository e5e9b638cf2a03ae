"""Frames decoded by several processes at once."""

from multiprocessing import get_context
from multiprocessing.queues import Queue
from multiprocessing.synchronize import Barrier
from pathlib import Path

import pytest

from lerobot_wm.data.cache import CameraCache, cache_root, camera_frames
from lerobot_wm.files import sole_writer
from tests.recording import FRONT, camera, record, vector

PROCESSES, ROUNDS = 4, 25


def _open_and_mark(rank: int, folder: Path, together: Barrier, results: Queue) -> None:
    for number in range(ROUNDS):
        together.wait()
        frames = CameraCache._open(folder / f"{number}.npy", (PROCESSES,))
        frames[rank] = 1
        together.wait()
        results.put(int(frames.sum()))


def test_processes_that_start_together_share_one_file(tmp_path: Path) -> None:
    # Two trainings on a new dataset each created the frames file; the later rename left the earlier process writing
    # into a deleted file, while the flags of decoded episodes told the other that its frames were there.
    context = get_context("fork")
    together, results = context.Barrier(PROCESSES), context.Queue()
    processes = [
        context.Process(target=_open_and_mark, args=(rank, tmp_path, together, results))
        for rank in range(PROCESSES)
    ]
    for process in processes:
        process.start()
    seen = [results.get(timeout=60) for _ in range(PROCESSES * ROUNDS)]
    for process in processes:
        process.join()
    assert seen == [PROCESSES] * (PROCESSES * ROUNDS)
    assert not list(tmp_path.glob("*.part"))


def test_a_dataset_in_the_current_folder_has_its_cache_beside_it(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    (tmp_path / "demos").mkdir()
    monkeypatch.chdir(tmp_path / "demos")
    assert cache_root(Path(".")) == tmp_path / "demos.cache"
    with sole_writer(Path(".")):
        assert (tmp_path / ".demos.lock").exists()


def test_frames_of_earlier_versions_are_named(tmp_path: Path, caplog: pytest.LogCaptureFixture) -> None:
    """Nothing removes them, and a large camera's take gigabytes."""
    dataset = record(tmp_path / "demos", {FRONT: camera(8, 8), "action": vector(2)}, [("Push", 3)])
    camera_frames(dataset, FRONT)
    [first] = (tmp_path / "demos.cache").glob("frames-*")
    camera_frames(dataset, FRONT)
    assert "earlier versions" not in caplog.text
    with (tmp_path / "demos" / "meta" / "info.json").open("a") as file:
        file.write("\n")
    camera_frames(dataset, FRONT)
    [told] = [record.message for record in caplog.records if "earlier versions" in record.message]
    assert str(first) in told
