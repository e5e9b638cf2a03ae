"""Jobs that share a collection or an encoding (`--shard=i/n`), and the merging of what they made."""

import json
import re
import shutil
from collections.abc import Callable
from pathlib import Path

import av
import numpy as np
import pytest
import torch
from lerobot.datasets import feature_utils
from lerobot.datasets.aggregate import aggregate_datasets
from lerobot.datasets.lerobot_dataset import LeRobotDataset

from lerobot_wm.collect.command import CollectConfig, collect
from lerobot_wm.collect.merge import merge_datasets
from lerobot_wm.collect.shards import SHARD_RECORD
from lerobot_wm.data.cache import CACHE_VARIABLE
from lerobot_wm.data.latents import LatentKind, LatentRecord
from lerobot_wm.encode.dataset import encode, encode_job, episode_batches, filter_batches
from lerobot_wm.policies.latent.policy import load_encoder
from lerobot_wm.system import quiet
from lerobot_wm.workers import Job

SHARDS = ("reach-v3-00000", "window-close-v3-00000")


def job(root: Path, **changes: object) -> CollectConfig:
    """The collection of the fixture `demos_root`."""
    settings = {"tasks": "reach-v3,window-close-v3", "episodes_per_task": 4, "num_workers": 1}
    return CollectConfig("test/demos", root, **{**settings, **changes})


def files(root: Path) -> dict[str, bytes]:
    """All of a dataset but the record of its collection, which holds a time."""
    paths = [path for path in root.rglob("*") if path.is_file() and path.name != "collection.json"]
    return {path.relative_to(root).as_posix(): path.read_bytes() for path in paths}


def packets(video: Path) -> list[tuple[int | None, bytes]]:
    """Time and compressed bytes of each frame."""
    with av.open(video) as container:
        return [(packet.pts, bytes(packet)) for packet in container.demux(video=0)]


@pytest.fixture(scope="module")
def parts(tmp_path_factory: pytest.TempPathFactory) -> list[Path]:
    """Folders of the shards of two jobs on two machines."""
    folder = tmp_path_factory.mktemp("parts")
    return [collect(job(folder / f"machine_{i}" / "dataset", shard=f"{i}/2")) for i in (1, 2)]


@pytest.fixture
def gathered(parts: list[Path], tmp_path: Path) -> Path:
    """The root of a dataset beside which all shards lie."""
    for part in parts:
        shutil.copytree(part, tmp_path / "dataset.shards", dirs_exist_ok=True)
    return tmp_path / "dataset"


def test_parts_merge_to_the_whole(parts: list[Path], gathered: Path, demos_root: Path) -> None:
    assert [[path.name for path in part.iterdir()] for part in parts] == [[SHARDS[0]], [SHARDS[1]]]
    collect(job(gathered))
    assert files(gathered) == files(demos_root)
    records = [json.loads((root / "meta" / "collection.json").read_text()) for root in (gathered, demos_root)]
    assert records[0]["episodes"] == records[1]["episodes"]
    assert not list(gathered.parent.glob("*.shards"))


def test_a_job_keeps_to_its_share(gathered: Path, capsys: pytest.CaptureFixture[str]) -> None:
    """Started again it collects nothing, and leaves alone what another job is writing."""
    folder = gathered.with_name("dataset.shards")
    shutil.rmtree(folder / SHARDS[1])
    for shard in SHARDS:
        (folder / f"{shard}.part").mkdir()
    collect(job(gathered, shard="1/2"))
    assert {path.name for path in folder.iterdir()} == {SHARDS[0], *(f"{shard}.part" for shard in SHARDS)}
    assert "Job 1/2 is done: 1 of 2 shards are in" in capsys.readouterr().out


def test_a_part_of_other_settings_is_refused(gathered: Path) -> None:
    with pytest.raises(FileExistsError, match=r"reach-v3-00000.*noise 0.3 there, 0.1 here"):
        collect(job(gathered, noise=0.1))
    record = gathered.with_name("dataset.shards") / SHARDS[1] / SHARD_RECORD
    content = json.loads(record.read_text())
    content["made_of"]["versions"]["mujoco"] = "1.0"
    record.write_text(json.dumps(content))
    with pytest.raises(FileExistsError, match=r"window-close.*versions .*'mujoco': '1.0'"):
        collect(job(gathered))


def test_a_part_of_another_collection_is_refused(gathered: Path) -> None:
    with pytest.raises(FileExistsError, match="window-close-v3-00000"):
        collect(job(gathered, tasks="reach-v3"))


def test_a_part_that_was_not_copied_whole_is_refused(gathered: Path) -> None:
    [video] = (gathered.with_name("dataset.shards") / SHARDS[0]).rglob("*.mp4")
    video.write_bytes(video.read_bytes()[:-100])
    with pytest.raises(ValueError, match="reach-v3-00000"):
        collect(job(gathered))
    video.unlink()
    with pytest.raises(ValueError, match="reach-v3-00000"):
        collect(job(gathered))


@pytest.mark.parametrize("shard", ["1", "a/b", "0/4", "5/4", "1/0", "-1/4"])
def test_shard_that_is_none(shard: str, tmp_path: Path) -> None:
    with pytest.raises(ValueError, match=f"shard is '{shard}'"):
        collect(job(tmp_path / "dataset", shard=shard))
    assert not any(tmp_path.iterdir())


def test_shares_are_disjoint_and_even() -> None:
    shares = [Job(i, 4).select(range(15)) for i in range(1, 5)]
    assert sorted(part for share in shares for part in share) == list(range(15))
    assert {len(share) for share in shares} == {3, 4}


def test_merged_as_by_lerobot(parts: list[Path], tmp_path: Path) -> None:
    """Every table has the same bytes, and the video the same packets, as LeRobot's own merging gives."""
    sources = [part / shard for part, shard in zip(parts, SHARDS, strict=True)] * 2 + [parts[0] / SHARDS[0]]
    with quiet():
        merge_datasets(sources, "test/merged", tmp_path / "ours")
        aggregate_datasets(["test/part"] * 5, "test/merged", sources, tmp_path / "theirs")
    ours, theirs = files(tmp_path / "ours"), files(tmp_path / "theirs")
    assert ours.keys() == theirs.keys()
    for name in ours:
        if name.endswith("stats.json"):  # which LeRobot orders at random
            stats = json.loads(ours[name])
            assert stats == json.loads(theirs[name])
            assert list(stats) == sorted(stats)
        elif name.endswith(".mp4"):
            assert packets(tmp_path / "ours" / name) == packets(tmp_path / "theirs" / name)
        else:
            assert ours[name] == theirs[name], name


def test_full_files_are_followed_by_new_ones(
    parts: list[Path], tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """With room for one shard in each table and two in each video, every frame is still found."""
    sources = [part / shard for part, shard in zip(parts, SHARDS, strict=True)] * 2
    shards = [LeRobotDataset("test/shard", root=source) for source in sources]
    sizes = [path.stat().st_size / 2**20 for source in sources for path in source.rglob("*.mp4")]
    monkeypatch.setattr(feature_utils, "DEFAULT_VIDEO_FILE_SIZE_IN_MB", sum(sizes[:2]) * 1.01)
    monkeypatch.setattr(feature_utils, "DEFAULT_DATA_FILE_SIZE_IN_MB", 1e-3)
    monkeypatch.setattr(feature_utils, "DEFAULT_CHUNK_SIZE", 3)
    with quiet():
        merge_datasets(sources, "test/merged", tmp_path / "merged")
    merged = LeRobotDataset("test/merged", root=tmp_path / "merged")
    paths = [path.relative_to(merged.root).as_posix() for path in sorted(merged.root.rglob("file*"))]
    tables = ["chunk-000/file-000", "chunk-000/file-001", "chunk-000/file-002", "chunk-001/file-000"]
    assert paths == [
        *(f"data/{name}.parquet" for name in tables),
        *(f"meta/episodes/{name}.parquet" for name in tables),
        *(f"videos/observation.image/{name}.mp4" for name in tables[:2]),
    ]
    frame = 0
    for shard in shards:
        for t in (0, 1, shard.num_frames // 2, shard.num_frames - 1):
            ours, theirs = merged[frame + t], shard[t]
            for key in ("observation.image", "observation.state", "action"):
                assert torch.equal(ours[key], theirs[key])
            assert ours["task"] == theirs["task"]
        frame += shard.num_frames
    assert frame == merged.num_frames


@pytest.fixture(scope="module")
def many_episodes(parts: list[Path], tmp_path_factory: pytest.TempPathFactory) -> LeRobotDataset:
    """24 episodes: two batches of the encoder, the second of other episodes than the first begins with."""
    root = tmp_path_factory.mktemp("many") / "dataset"
    a, b = (part / shard for part, shard in zip(parts, SHARDS, strict=True))
    with quiet():
        merge_datasets([a, b, a, b, b, a], "test/many", root)
    return LeRobotDataset("test/many", root=root)


def test_encoded_parts_make_the_whole(
    many_episodes: LeRobotDataset,
    world_model_path: Path,
    tmp_path: Path,
    lerobot_wm_command: Callable[..., None],
    capsys: pytest.CaptureFixture[str],
) -> None:
    def command(root: Path, *flags: str) -> None:
        lerobot_wm_command(
            f"encode --world_model_path={world_model_path} --device=cpu --output_repo_id=test/latents",
            f"--dataset.repo_id=test/many --dataset.root={many_episodes.root} --output_root={root}",
            *flags,
        )

    command(tmp_path / "whole")
    for i in (1, 2):
        command(tmp_path / f"machine_{i}" / "latents", f"--shard={i}/2")
        assert f"Job {i}/2 is done: 1 of 2 batches are in" in capsys.readouterr().out
        shutil.copytree(
            tmp_path / f"machine_{i}" / "latents.parts", tmp_path / "latents.parts", dirs_exist_ok=True
        )
    command(tmp_path / "latents")
    assert "2 of 2 batches are already in" in capsys.readouterr().out
    assert files(tmp_path / "latents") == files(tmp_path / "whole")
    record = LatentRecord.read(tmp_path / "latents")
    assert record == LatentRecord.read(tmp_path / "whole")
    assert not (tmp_path / "latents.parts").exists()
    assert not (tmp_path / "whole.parts").exists()


def test_latents_of_a_batch_do_not_depend_on_those_before(
    many_episodes: LeRobotDataset, world_model_path: Path
) -> None:
    policy, batches = load_encoder(str(world_model_path)), episode_batches(many_episodes)
    assert batches == [range(16), range(16, 24)]
    both = list(filter_batches(policy, many_episodes, batches, kind=LatentKind(random_crop_pad=2)))
    [alone] = filter_batches(policy, many_episodes, batches[1:], kind=LatentKind(random_crop_pad=2))
    assert torch.equal(alone, both[1])
    assert len(torch.cat(both)) == many_episodes.num_frames


def test_a_job_decodes_its_own_episodes_only(
    many_episodes: LeRobotDataset, world_model_path: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setenv(CACHE_VARIABLE, str(tmp_path / "cache"))
    encode_job(load_encoder(str(world_model_path)), many_episodes, tmp_path / "latents", Job(2, 2))
    [decoded] = (tmp_path / "cache").rglob("*.decoded.npy")
    assert np.flatnonzero(np.load(decoded)).tolist() == list(range(16, 24))


def test_latents_of_another_world_model_are_refused(
    many_episodes: LeRobotDataset, world_model_path: Path, tmp_path: Path
) -> None:
    policy = load_encoder(str(world_model_path))
    encode_job(policy, many_episodes, tmp_path / "latents", Job(2, 2))
    [part] = (tmp_path / "latents.parts").iterdir()
    with torch.no_grad():
        next(policy.world_model.parameters()).add_(1)
    with pytest.raises(FileExistsError, match="world_model_fingerprint"):
        encode_job(policy, many_episodes, tmp_path / "latents", Job(1, 2))
    part.write_bytes(part.read_bytes()[:-1])
    with pytest.raises(ValueError, match=re.escape(str(part))):
        encode_job(policy, many_episodes, tmp_path / "latents", Job(1, 2))


def test_what_jobs_made_is_not_removed_for_the_sake_of_something_else(
    many_episodes: LeRobotDataset, world_model_path: Path, tmp_path: Path
) -> None:
    policy, root = load_encoder(str(world_model_path)), tmp_path / "latents"
    encode_job(policy, many_episodes, root, Job(2, 2))
    root.mkdir()
    with pytest.raises(FileExistsError, match=re.escape(str(root))):
        encode(policy, many_episodes, "test/latents", root)
    assert len(list((tmp_path / "latents.parts").iterdir())) == 1


def test_a_push_of_other_latents_is_refused(
    demos_root: Path,
    world_model_path: Path,
    tmp_path: Path,
    lerobot_wm_command: Callable[..., None],
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    pushed = []
    monkeypatch.setattr("lerobot_wm.encode.command.check_can_push", lambda repo_id: None)
    monkeypatch.setattr("lerobot_wm.encode.command.push_latents", lambda *args: pushed.append(args))

    def push(world_model: Path) -> None:
        lerobot_wm_command(
            f"encode --world_model_path={world_model} --device=cpu --dataset.repo_id=test/demos",
            f"--dataset.root={demos_root} --output_repo_id=user/latents --output_root={tmp_path / 'latents'}",
            "--push_to_hub=true",
        )

    push(world_model_path)
    push(world_model_path)
    other = load_encoder(str(world_model_path))
    with torch.no_grad():
        next(other.world_model.parameters()).add_(1)
    other.save_pretrained(tmp_path / "other")
    with pytest.raises(FileExistsError, match="world_model_fingerprint"):
        push(tmp_path / "other")
    assert len(pushed) == 2
