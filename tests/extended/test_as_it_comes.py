"""Datasets as recorders and converters write them: each trains, or the advice in the message works."""

import json
import re
import shlex
import shutil
import subprocess
import sys
from collections.abc import Callable, Mapping
from pathlib import Path
from typing import Any

import numpy as np
import pandas as pd
import pyarrow as pa
import pyarrow.parquet as pq
import pytest
import torch
from lerobot.datasets.lerobot_dataset import LeRobotDataset
from lerobot.policies import make_policy

from lerobot_wm.commands.repair import repair
from lerobot_wm.data.cache import camera_frames
from lerobot_wm.data.source import DatasetError, open_dataset
from lerobot_wm.policies.e2e_bc.configuration_e2e_bc import E2EBCConfig
from lerobot_wm.policies.e2e_bc.modeling_e2e_bc import E2EBCPolicy
from lerobot_wm.policies.wm_rssm.configuration_wm_rssm import WMRSSMConfig
from tests.flags import SMALL_WORLD_MODEL
from tests.recording import FRONT, camera, record, train_flags, vector

NAME = "test/recorded"
DATA = "data/chunk-000/file-000.parquet"
FEATURES = {FRONT: camera(32, 48), "observation.state": vector(6), "action": vector(6)}
STEPS = f"--policy.type=wm_rssm --policy.window_length=4 --steps=2 --batch_size=2 {SMALL_WORLD_MODEL}"


@pytest.fixture(scope="module")
def video_episodes(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Three episodes with a video and a table each."""
    root = tmp_path_factory.mktemp("videos") / "dataset"
    create = LeRobotDataset.create

    def small_files(*args: Any, **kwargs: Any) -> LeRobotDataset:
        return create(*args, **kwargs, video_files_size_in_mb=1e-3, data_files_size_in_mb=1e-3)

    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(LeRobotDataset, "create", small_files)
        record(root, FEATURES | {FRONT: camera(32, 48, "video")}, [("Wave", 6), ("Wave", 9), ("Nod", 7)])
    return root


def small(root: Path, features: Mapping[str, Any] = FEATURES, **kwargs: Any) -> LeRobotDataset:
    return record(root, dict(features), [("Wave", 6), ("Wave", 9), ("Nod", 7)], **kwargs)


def edit_info(root: Path, edit: Callable[[dict[str, Any]], Any]) -> None:
    path = root / "meta/info.json"
    info = json.loads(path.read_text())
    edit(info)
    path.write_text(json.dumps(info))


def set_column(root: Path, name: str, values: Any) -> None:
    table = pq.read_table(root / DATA)
    index = table.schema.get_field_index(name)
    field = table.schema.field(index)
    pq.write_table(table.set_column(index, field, pa.array(values, field.type)), root / DATA)


def run_command_in(message: str, folder: Path) -> Path:
    """Run the command between backquotes in a message as a user would, in `folder`; returns the folder it writes."""
    [command] = re.findall(r"`([^`]+)`", message)
    program, *arguments = shlex.split(command)
    module = {
        "lerobot-wm": "lerobot_wm.cli",
        "lerobot-edit-dataset": "lerobot.scripts.lerobot_edit_dataset",
    }[program]
    subprocess.run([sys.executable, "-m", module, *arguments], cwd=folder, check=True, capture_output=True)
    [output] = re.findall(r"--(?:output|new)_root=(\S+)", command)
    return folder / output


@pytest.mark.parametrize(
    "names", [["height", "width", "rgb"], ["h", "w", "c"], ["width", "height", "channel"]]
)
def test_axes_of_cameras_may_have_any_names(
    names: list[str], tmp_path: Path, lerobot_wm_command: Callable[..., None]
) -> None:
    dataset = small(tmp_path / "data")
    edit_info(tmp_path / "data", lambda info: info["features"][FRONT].update(names=names))
    meta = open_dataset(NAME, dataset.root)
    for config in (WMRSSMConfig(device="cpu"), E2EBCConfig(device="cpu", image_key=FRONT)):
        policy = make_policy(config, ds_meta=meta)
        assert policy.config.input_features[FRONT].shape == (3, 32, 48)
    frames = camera_frames(LeRobotDataset(NAME, root=dataset.root), FRONT)
    assert frames.shape == (22, 32, 48, 3)
    lerobot_wm_command("train", STEPS, train_flags(dataset), f"--output_dir={tmp_path / 'run'}")


def test_axes_of_cameras_may_begin_with_channels(tmp_path: Path) -> None:
    small(tmp_path / "data")
    camera_entry = {"shape": [3, 32, 48], "names": ["rgb", "height", "width"]}
    edit_info(tmp_path / "data", lambda info: info["features"][FRONT].update(camera_entry))
    frames = camera_frames(LeRobotDataset(NAME, root=tmp_path / "data"), FRONT)
    assert frames.shape == (22, 32, 48, 3)


def test_files_of_other_episodes_may_be_missing(
    video_episodes: Path, tmp_path: Path, lerobot_wm_command: Callable[..., None]
) -> None:
    root = shutil.copytree(video_episodes, tmp_path / "data")
    for name in (f"videos/{FRONT}/chunk-000/file-001.mp4", "data/chunk-000/file-001.parquet"):
        (root / name).unlink()
    with pytest.raises(DatasetError, match=r"file-001"):
        open_dataset(NAME, root)
    with pytest.raises(DatasetError, match=r"file-001"):
        open_dataset(NAME, root, episodes=[0, 1])
    dataset = LeRobotDataset(NAME, root=root, episodes=[0, 2])
    lerobot_wm_command(
        "train --dataset.episodes=[0,2]", STEPS, train_flags(dataset), f"--output_dir={tmp_path / 'run'}"
    )
    # Policies on latents encode all episodes. The advice is to train one that reads images.
    policy = (
        f"--policy.type=wm_bc --policy.world_model_path={tmp_path / 'run/checkpoints/last/pretrained_model'}"
    )
    flags = f"train --dataset.episodes=[0,2] {policy} --steps=2 --batch_size=2 {train_flags(dataset)}"
    with pytest.raises(DatasetError, match=r"--policy.finetune_world_model=true") as refusal:
        lerobot_wm_command(flags, f"--output_dir={tmp_path / 'policy'}")
    assert "file-001" in str(refusal.value)
    lerobot_wm_command(flags, f"--policy.finetune_world_model=true --output_dir={tmp_path / 'policy'}")


@pytest.mark.parametrize("everywhere", [False, True])
def test_nan_is_named_and_removed(everywhere: bool, tmp_path: Path) -> None:
    def labels(t: int, length: int) -> dict[str, Any]:
        broken = everywhere or (t, length) == (4, 9)
        return {"observation.state": np.full(6, np.nan if broken and t == 4 else t, np.float32)}

    root = tmp_path / "recorded"
    small(root, labels=labels)
    with pytest.raises(DatasetError, match=r"observation\.state.* frame 4\b") as refusal:
        open_dataset(NAME, root)
    assert f"episode {0 if everywhere else 1} " in str(refusal.value)
    meta = open_dataset(f"{NAME}_finite", run_command_in(str(refusal.value), tmp_path))
    assert ("observation.state" in meta.features) != everywhere
    assert meta.total_episodes == (3 if everywhere else 2)


def test_actions_that_are_nan_everywhere_have_no_removal(tmp_path: Path) -> None:
    def labels(t: int, length: int) -> dict[str, Any]:
        return {"action": np.full(6, np.nan if t == length - 1 else t, np.float32)}

    small(tmp_path / "recorded", labels=labels)
    with pytest.raises(DatasetError, match=r"action is NaN .* every episode; in episode 0, it is in frame 5"):
        open_dataset(NAME, tmp_path / "recorded")


def test_cameras_may_have_any_name_after_observation(
    tmp_path: Path, lerobot_wm_command: Callable[..., None]
) -> None:
    features = {"observation.rgb": camera(32, 48), "observation.state": vector(6), "action": vector(6)}
    dataset = record(tmp_path / "data", features, [("Wave", 6), ("Wave", 9)])
    lerobot_wm_command(
        f"train --policy.type=e2e_bc --steps=1 --batch_size=2 {train_flags(dataset)}",
        f"--output_dir={tmp_path / 'run'}",
    )
    path = tmp_path / "run/checkpoints/last/pretrained_model"
    policy = E2EBCPolicy.from_pretrained(path)
    frame = {key: dataset[0][key][None] for key in ("observation.rgb", "observation.state")}
    assert policy.select_action(frame | {"task": ["Wave"]}).shape == (1, 6)


def write_wall_clock(root: Path) -> None:
    times = [t * 0.11 + 0.01 * (t % 3) for length in (6, 9, 7) for t in range(length)]
    set_column(root, "timestamp", times)


def remove_numbering(root: Path) -> None:
    edit_info(
        root, lambda info: [info["features"].pop(key) for key in ("frame_index", "index", "task_index")]
    )


def remove_columns(root: Path) -> None:
    table = pq.read_table(root / DATA).drop_columns(["episode_index", "index", "task_index", "timestamp"])
    pq.write_table(table, root / DATA)


def number_within_episodes(root: Path) -> None:
    set_column(root, "index", [t for length in (6, 9, 7) for t in range(length)])


def as_version_2(root: Path, version: str) -> None:
    """Write a dataset whose episodes have files of their own as LeRobot 2.0 or 2.1 did."""
    info = json.loads((root / "meta/info.json").read_text())
    episodes = pd.concat(map(pd.read_parquet, (root / "meta/episodes").rglob("*.parquet")))
    tasks = pd.read_parquet(root / "meta/tasks.parquet")
    stats = json.loads((root / "meta/stats.json").read_text())
    info |= {"codebase_version": version, "total_chunks": 1, "total_videos": len(episodes)}
    info |= {"data_path": "data/chunk-{episode_chunk:03d}/episode_{episode_index:06d}.parquet"}
    lines: dict[str, list[Any]] = {"episodes": [], "episodes_stats": []}
    for number, episode in enumerate(episodes.itertuples()):
        for path in (f"videos/{FRONT}/chunk-000/file-{number:03}.mp4", f"{DATA[:-11]}{number:03}.parquet"):
            old = root / path
            folder = f"videos/chunk-000/{FRONT}" if old.suffix == ".mp4" else "data/chunk-000"
            new = root / folder / f"episode_{number:06}{old.suffix}"
            new.parent.mkdir(parents=True, exist_ok=True)
            old.rename(new)
        lines["episodes"].append(
            {"episode_index": number, "tasks": list(episode.tasks), "length": episode.length}
        )
        of_episode = {key: {**values, "count": [episode.length]} for key, values in stats.items()}
        lines["episodes_stats"].append({"episode_index": number, "stats": of_episode})
    lines["tasks"] = [{"task_index": int(i), "task": task} for task, i in tasks["task_index"].items()]
    if version == "v2.0":
        del lines["episodes_stats"]
    else:
        (root / "meta/stats.json").unlink()
    for name, of_file in lines.items():
        (root / f"meta/{name}.jsonl").write_text("".join(json.dumps(line) + "\n" for line in of_file))
    shutil.rmtree(root / "meta/episodes")
    (root / "meta/tasks.parquet").unlink()
    shutil.rmtree(root / f"videos/{FRONT}")
    (root / "meta/info.json").write_text(json.dumps(info))


@pytest.mark.parametrize(
    "spoil", [write_wall_clock, remove_numbering, remove_columns, number_within_episodes]
)
def test_a_repaired_copy_has_frames_as_they_were_recorded(
    spoil: Callable[[Path], None], tmp_path: Path
) -> None:
    root = tmp_path / "recorded"
    recorded = small(root)
    frames = [recorded[row] for row in (0, 8, 21)]
    spoil(root)
    before = (root / DATA).read_bytes()
    with pytest.raises(DatasetError, match=re.escape(str(root))) as refusal:
        open_dataset(NAME, root)
    output = tmp_path / "data" / "recorded_repaired"
    assert f"lerobot-wm repair --dataset.repo_id={NAME} --dataset.root={root}" in str(refusal.value)
    repair(NAME, root, output)
    repaired = LeRobotDataset(NAME, root=output)
    for row, frame in zip((0, 8, 21), frames, strict=True):
        for key, value in frame.items():
            assert value == repaired[row][key] if key == "task" else torch.equal(value, repaired[row][key])
    assert (root / DATA).read_bytes() == before


def test_frames_may_be_counted_from_any_number(tmp_path: Path) -> None:
    root = tmp_path / "trimmed"
    small(root)
    set_column(root, "frame_index", [t + 30 for length in (6, 9, 7) for t in range(length)])
    open_dataset(NAME, root)
    write_wall_clock(root)
    repair(NAME, root, tmp_path / "repaired")


@pytest.mark.parametrize("version", ["v2.0", "v2.1"])
def test_data_of_lerobot_2_is_converted(version: str, video_episodes: Path, tmp_path: Path) -> None:
    recorded = LeRobotDataset(NAME, root=video_episodes)
    root = shutil.copytree(video_episodes, tmp_path / "recorded")
    as_version_2(root, version)
    with pytest.raises(DatasetError, match=f"'{version}'") as refusal:
        open_dataset(NAME, root)
    output = run_command_in(str(refusal.value), tmp_path)
    converted = LeRobotDataset(NAME, root=output)
    assert converted.meta.stats["action"]["std"] == pytest.approx(recorded.meta.stats["action"]["std"])
    for row in (0, 8, 21):
        for key in (FRONT, "action", "timestamp", "index"):
            assert torch.equal(recorded[row][key], converted[row][key]), key
    assert sorted(path.name for path in output.parent.iterdir()) == [output.name]
    assert (root / "meta/episodes.jsonl").exists()


@pytest.mark.parametrize(("version", "name"), [("v2.0", "stats.json"), ("v2.1", "episodes_stats.jsonl")])
def test_statistics_that_conversion_needs_are_named(
    version: str, name: str, video_episodes: Path, tmp_path: Path
) -> None:
    root = shutil.copytree(video_episodes, tmp_path / "recorded")
    as_version_2(root, version)
    (root / "meta" / name).unlink()
    with pytest.raises(DatasetError, match=re.escape(f"meta/{name}")):
        repair(NAME, root, tmp_path / "output")
    assert not (tmp_path / "output").exists()


def test_what_repair_cannot_mend_is_not_written(tmp_path: Path) -> None:
    root = tmp_path / "recorded"
    small(root)
    table = pq.read_table(root / DATA)
    pq.write_table(table.slice(0, len(table) - 1), root / DATA)
    with pytest.raises(DatasetError, match=r"21 frames.* 22\b"):
        repair(NAME, root, tmp_path / "output")
    assert not (tmp_path / "output").exists()
