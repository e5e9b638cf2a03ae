"""Collections in several processes, killed and started again."""

import hashlib
import json
import os
import signal
import subprocess
import sys
import time
from collections.abc import Callable
from pathlib import Path

import pytest
from lerobot.datasets.lerobot_dataset import LeRobotDataset

from lerobot_wm.pipeline.collect import CollectConfig, collect, plan_shards
from lerobot_wm.pipeline.collect_shards import SHARD_RECORD

EPISODES = 2
# One more than there are workers: the third shard is begun when the first is finished.
TASKS = "reach-v3,window-close-v3,drawer-close-v3"
SHARDS = 3


def command(root: Path) -> list[str]:
    return [
        *(sys.executable, "-m", "lerobot_wm.cli", "collect", f"--root={root}", "--repo_id=user/small"),
        *(f"--tasks={TASKS}", f"--episodes_per_task={EPISODES}"),
    ]


def contents(root: Path) -> dict[str, str]:
    """SHA-256 of every data file and video, and the record without its wall time."""
    digests = {
        str(path.relative_to(root)): hashlib.sha256(path.read_bytes()).hexdigest()
        for folder in ("data", "videos")
        for path in sorted((root / folder).rglob("*.*"))
        if path.is_file()
    }
    record = json.loads((root / "meta" / "collection.json").read_text())
    return {**digests, "episodes": json.dumps(record["episodes"])}


def wait_until(condition: Callable[[], object], seconds: float = 120.0) -> None:
    end = time.monotonic() + seconds
    while not condition():
        assert time.monotonic() < end, "timed out"
        time.sleep(0.01)


def processes_of(group: int) -> list[int]:
    """Living processes of a process group."""
    found = []
    for stat in Path("/proc").glob("[0-9]*/stat"):
        try:
            fields = stat.read_text().rpartition(")")[2].split()
        except OSError:  # it has just ended
            continue
        if int(fields[2]) == group and fields[0] != "Z":
            found.append(int(stat.parent.name))
    return found


@pytest.fixture(scope="module")
def undisturbed(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """The dataset as one process makes it in one go."""
    root = tmp_path_factory.mktemp("undisturbed") / "dataset"
    config = CollectConfig(
        repo_id="user/small", root=root, tasks=TASKS, episodes_per_task=EPISODES, num_workers=1
    )
    return collect(config)


@pytest.mark.skipif(not Path("/proc").exists(), reason="looks for left-over processes in /proc")
def test_killed_and_started_again(undisturbed: Path, tmp_path: Path) -> None:
    """Two workers, killed when a shard is finished: nothing is lost, left over or different."""
    root, shards = tmp_path / "dataset", tmp_path / "dataset.shards"
    run = subprocess.Popen(command(root), start_new_session=True, stderr=subprocess.DEVNULL)
    wait_until(lambda: list(shards.glob(f"*-v3-*/{SHARD_RECORD}")) or run.poll() is not None)
    assert run.poll() is None
    os.kill(run.pid, signal.SIGKILL)
    run.wait()
    wait_until(lambda: not processes_of(run.pid), seconds=10)  # workers end with their parent

    finished = [path.parent for path in shards.glob(f"[!u]*/{SHARD_RECORD}")]
    assert 1 <= len(finished) < SHARDS
    for shard in finished:
        assert LeRobotDataset("user/shard", root=shard).num_episodes == EPISODES
    written = [(shard / SHARD_RECORD).stat().st_mtime_ns for shard in finished]
    assert not root.exists()

    other = CollectConfig("user/small", root=root, tasks=TASKS, episodes_per_task=EPISODES, noise=0.1)
    with pytest.raises(FileExistsError, match=r"noise 0.3 there, 0.1 here"):
        collect(other)
    assert [(shard / SHARD_RECORD).stat().st_mtime_ns for shard in finished] == written

    again = subprocess.run(command(root), capture_output=True, text=True)
    assert again.returncode == 0, again.stderr
    assert (
        f"{len(finished) * EPISODES}/{SHARDS * EPISODES}" in again.stderr
    )  # the bar starts from the finished episodes
    assert "libx264" not in again.stderr
    assert not shards.exists()
    assert contents(root) == contents(undisturbed)


def test_plan_covers_every_episode_once() -> None:
    shards = plan_shards(CollectConfig(repo_id="user/x", tasks="mt10", episodes_per_task=30))
    episodes = [(shard.task, e) for shard in shards for e in range(shard.first, shard.first + shard.count)]
    assert len(episodes) == len(set(episodes)) == 300
    assert len({shard.name for shard in shards}) == len(shards)
