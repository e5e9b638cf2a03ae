"""The RAM path serves what LeRobot's own DataLoader serves."""

import shutil
from hashlib import file_digest
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest
import torch
from lerobot.datasets.lerobot_dataset import LeRobotDataset
from lerobot.datasets.video_utils import decode_video_frames
from torch.utils.data import DataLoader, Subset

from lerobot_wm.data.cache import CACHE_VARIABLE, camera_frames
from lerobot_wm.data.latents import dataset_fingerprint
from lerobot_wm.data.loader import RamDataset, RamLoader, gather

CPU = torch.device("cpu")


def windows(length: int, fps: int = 80) -> dict[str, list[float]]:
    keys = ("observation.image", "observation.state", "action", "next.reward")
    return {key: [i / fps for i in range(length)] for key in keys}


def assert_equal_batches(dataset: LeRobotDataset | Subset, indices: list[int]) -> None:
    loader = DataLoader(dataset, batch_size=4, sampler=indices)
    ours = RamLoader(loader, loader.batch_sampler, CPU)
    assert len(ours) == len(loader)
    for theirs, batch in zip(loader, ours, strict=True):
        assert theirs.keys() == batch.keys()
        assert list(theirs.pop("task")) == batch.pop("task")
        for key, value in theirs.items():
            assert value.dtype == batch[key].dtype, key
            assert torch.equal(value, batch[key]), key


def some_indices(dataset: LeRobotDataset, step: int = 17) -> list[int]:
    """Rows across the whole dataset, the last frames of episodes among them."""
    ends = np.cumsum(dataset.meta.episodes["length"])[: dataset.num_episodes] - 1
    return [*range(0, dataset.num_frames, step), *(end for end in ends.tolist() if end < dataset.num_frames)]


def test_windows_equal_lerobots(demos_root: Path) -> None:
    dataset = LeRobotDataset("test/demos", root=demos_root, delta_timestamps=windows(5), return_uint8=True)
    assert_equal_batches(dataset, some_indices(dataset))


def test_single_frames_equal_lerobots(demos_root: Path) -> None:
    dataset = LeRobotDataset("test/demos", root=demos_root, return_uint8=True)
    assert_equal_batches(dataset, some_indices(dataset))


def test_chosen_episodes_and_subset_equal_lerobots(demos_root: Path) -> None:
    dataset = LeRobotDataset(
        "test/demos", root=demos_root, episodes=[1, 5], delta_timestamps=windows(3), return_uint8=True
    )
    assert_equal_batches(dataset, [0, 1, dataset.num_frames - 2, dataset.num_frames - 1])
    assert_equal_batches(Subset(dataset, [3, 70, 9]), [0, 1, 2])


def test_frames_that_lie_on_the_device_are_those_of_the_datasets_own_episodes(
    demos_root: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """As on a GPU, whose memory holds training and evaluation episodes once."""
    monkeypatch.setattr(RamDataset, "_fit_on_device", lambda self: True)
    monkeypatch.setattr("lerobot_wm.data.loader._COPIED_AT_ONCE", 50)
    for episodes in ([1, 5], None):
        dataset = LeRobotDataset(
            "test/demos", root=demos_root, episodes=episodes, delta_timestamps=windows(3), return_uint8=True
        )
        assert_equal_batches(dataset, [0, 1, dataset.num_frames - 2, dataset.num_frames - 1])
        frames = RamDataset(dataset, CPU)._cameras["observation.image"]
        assert frames.shape == (dataset.num_frames, 64, 64, 3)
        assert frames.dtype == torch.uint8


def test_frames_for_which_the_device_has_no_room_after_all_are_served_from_ram(
    demos_root: Path, monkeypatch: pytest.MonkeyPatch, caplog: pytest.LogCaptureFixture
) -> None:
    """Trainings that start together on one GPU all see the same free memory."""

    def full(self: RamDataset, frames: torch.Tensor) -> torch.Tensor:
        raise torch.OutOfMemoryError("CUDA out of memory.")

    monkeypatch.setattr(RamDataset, "_fit_on_device", lambda self: True)
    monkeypatch.setattr(RamDataset, "_on_device", full)
    dataset = LeRobotDataset("test/demos", root=demos_root, delta_timestamps=windows(3), return_uint8=True)
    assert_equal_batches(dataset, some_indices(dataset))
    assert "frames are served from RAM" in caplog.text


def test_past_frames_and_uneven_deltas_equal_lerobots(demos_root: Path) -> None:
    deltas = {"observation.state": [-2 / 80, 0.0], "action": [0.0, 3 / 80]}
    dataset = LeRobotDataset("test/demos", root=demos_root, delta_timestamps=deltas, return_uint8=True)
    assert_equal_batches(dataset, some_indices(dataset))


def test_png_dataset_of_two_cameras_equals_lerobots(tmp_path: Path) -> None:
    shapes = {"observation.images.left": (20, 24, 3), "observation.images.right": (12, 10, 3)}
    names = ["height", "width", "channels"]
    features = {
        **{key: {"dtype": "image", "shape": shape, "names": names} for key, shape in shapes.items()},
        "observation.state": {"dtype": "float32", "shape": (3,), "names": None},
        "action": {"dtype": "float32", "shape": (1,), "names": None},
    }
    dataset = LeRobotDataset.create("test/png", 10, features, root=tmp_path / "png", use_videos=False)
    rng = np.random.default_rng(0)
    for length in (4, 6):
        for _ in range(length):
            dataset.add_frame(
                {
                    **{key: rng.integers(0, 256, shape, dtype=np.uint8) for key, shape in shapes.items()},
                    "observation.state": rng.random(3, dtype=np.float32),
                    "action": rng.random(1, dtype=np.float32),
                    "task": "look",
                }
            )
        dataset.save_episode()
    dataset.finalize()
    deltas = {key: [0.0, 0.1] for key in (*shapes, "action")}
    dataset = LeRobotDataset("test/png", root=tmp_path / "png", delta_timestamps=deltas)
    assert_equal_batches(dataset, list(range(10)))


def test_columns_of_text_equal_lerobots(tmp_path: Path) -> None:
    features = {
        "observation.state": {"dtype": "float32", "shape": (3,), "names": None},
        "remark": {"dtype": "string", "shape": (1,), "names": None},
    }
    dataset = LeRobotDataset.create("test/text", 10, features, root=tmp_path / "text")
    for episode, length in enumerate((4, 6)):
        for t in range(length):
            state = np.full(3, t, dtype=np.float32)
            dataset.add_frame({"observation.state": state, "remark": f"{episode}.{t}", "task": "look"})
        dataset.save_episode()
    dataset.finalize()
    rows = [9, 0, 4, 3, 8, 1]
    for chosen, expected in (
        (None, ["1.5", "0.0", "1.0", "0.3", "1.4", "0.1"]),
        ([1], ["1.5", "1.0", "1.4"]),
    ):
        dataset = LeRobotDataset("test/text", root=tmp_path / "text", episodes=chosen)
        wanted = rows if chosen is None else [5, 0, 4]
        loader = DataLoader(dataset, batch_size=len(wanted), sampler=wanted)
        [theirs], [ours] = list(loader), list(RamLoader(loader, loader.batch_sampler, CPU))
        assert theirs.keys() == ours.keys()
        assert theirs["remark"] == ours["remark"] == expected


def test_depth_cameras_are_refused(tmp_path: Path) -> None:
    camera = {
        "dtype": "image",
        "shape": (8, 8, 1),
        "names": ["height", "width", "channels"],
        "info": {"is_depth_map": True, "depth_unit": "mm"},
    }
    action = {"dtype": "float32", "shape": (1,), "names": None}
    dataset = LeRobotDataset.create(
        "test/depth", 10, {"observation.images.depth": camera, "action": action}, root=tmp_path / "depth"
    )
    depth = np.zeros((8, 8, 1), dtype=np.uint16)
    dataset.add_frame({"observation.images.depth": depth, "action": np.zeros(1, np.float32), "task": "look"})
    dataset.save_episode()
    dataset.finalize()
    dataset = LeRobotDataset("test/depth", root=tmp_path / "depth")
    for read in (
        lambda: RamDataset(dataset, CPU),
        lambda: camera_frames(dataset, "observation.images.depth"),
    ):
        with pytest.raises(ValueError, match=r"observation\.images\.depth.*--policy\.image_key"):
            read()


def test_a_window_never_crosses_an_episode(demos_root: Path) -> None:
    length = 25
    dataset = LeRobotDataset("test/demos", root=demos_root, delta_timestamps=windows(length))
    source = RamDataset(dataset, CPU)
    frame_of_row = source._columns["frame_index"]
    batch = source.batch(list(range(dataset.num_frames)))
    frames_left = torch.tensor(dataset.meta.episodes["length"])[batch["episode_index"]] - frame_of_row
    assert torch.equal((~batch["action_is_pad"]).sum(1), frames_left.clamp(max=length))
    # whatever is padded repeats the episode's last action
    last = batch["action"][:, -1]
    padded = batch["action_is_pad"][:, -1]
    next_rows = (torch.arange(dataset.num_frames) + frames_left - 1)[padded]
    assert torch.equal(last[padded], source._columns["action"][next_rows])


def test_frames_are_decoded_once_and_decoding_resumes(demos_root: Path) -> None:
    dataset = LeRobotDataset("test/demos", root=demos_root)
    first = camera_frames(dataset, "observation.image").clone()
    folder = next(demos_root.with_name("dataset.cache").glob("frames-*"))
    stored = np.load(folder / "observation.image.npy", mmap_mode="r+")
    marks = np.load(folder / "observation.image.decoded.npy", mmap_mode="r+")
    stop = dataset.meta.episodes[0]["dataset_to_index"]
    stored[:] = 7  # a second decoding would restore every frame
    marks[0] = 0  # as after a kill before the first episode was marked
    stored.flush(), marks.flush()
    again = camera_frames(dataset, "observation.image")
    assert torch.equal(again[:stop], first[:stop])
    assert (again[stop:] == 7).all()
    stored[:] = first.numpy()
    stored.flush()


def test_frames_that_do_not_fit_on_the_disk_are_refused(
    demos_root: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    # Writing them through the memory map would end in a bus error when the disk is full.
    monkeypatch.setenv(CACHE_VARIABLE, str(tmp_path))
    dataset = LeRobotDataset("test/demos", root=demos_root)
    needed = dataset.num_frames * 64 * 64 * 3
    monkeypatch.setattr(shutil, "disk_usage", lambda _: SimpleNamespace(free=needed - 1))
    with pytest.raises(OSError, match=CACHE_VARIABLE):
        camera_frames(dataset, "observation.image")
    monkeypatch.setattr(shutil, "disk_usage", lambda _: SimpleNamespace(free=needed))
    assert len(camera_frames(dataset, "observation.image")) == dataset.num_frames


def test_fingerprint_changes_with_content(demos_root: Path, tmp_path: Path) -> None:
    copy = tmp_path / "copy"
    shutil.copytree(demos_root, copy)
    assert dataset_fingerprint(copy) == dataset_fingerprint(demos_root)
    stats = copy / "meta" / "stats.json"
    stats.write_text(stats.read_text().replace("0", "1", 1))
    assert dataset_fingerprint(copy) != dataset_fingerprint(demos_root)


def test_gathering_equals_indexing() -> None:
    source = torch.arange(60).reshape(20, 3)
    runs = torch.tensor([[0, 1, 2], [17, 18, 19]])
    repeats = torch.tensor([[0, 0, 1], [5, 4, 3]])
    for index in (runs, repeats, torch.tensor([3, 1])):
        assert torch.equal(gather(source, index), source[index])


def test_image_transforms_are_refused(demos_root: Path) -> None:
    dataset = LeRobotDataset("test/demos", root=demos_root, image_transforms=torch.nn.Identity())
    with pytest.raises(ValueError, match="image_transforms"):
        RamDataset(dataset, CPU)


def test_frames_of_videos_are_those_that_lerobot_decodes(demos_root: Path) -> None:
    dataset = LeRobotDataset("test/demos", root=demos_root)
    key, meta = "observation.image", dataset.meta
    frames = camera_frames(dataset, key).movedim(-1, 1)  # (N, C, H, W)
    for episode in meta.episodes:
        rows = range(episode["dataset_from_index"], episode["dataset_to_index"])
        times = [episode[f"videos/{key}/from_timestamp"] + t / meta.fps for t in range(len(rows))]
        path = demos_root / meta.get_video_file_path(episode["episode_index"], key)
        theirs = decode_video_frames(path, times, 1e-4, backend="pyav", return_uint8=True)
        assert torch.equal(frames[rows.start : rows.stop], theirs)


def test_a_dataset_is_hashed_again_only_when_it_changes(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    hashed: list[str] = []

    def counted(file: Any, name: str) -> Any:
        hashed.append(Path(file.name).name)
        return file_digest(file, name)

    monkeypatch.setattr("hashlib.file_digest", counted)
    (tmp_path / "data").mkdir()
    file = tmp_path / "data" / "table"
    file.write_text("a")
    first = dataset_fingerprint(tmp_path)
    assert dataset_fingerprint(tmp_path) == first
    assert hashed == ["table"]
    file.write_text("ab")
    assert dataset_fingerprint(tmp_path) != first
