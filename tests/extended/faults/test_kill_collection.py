"""Collections in several processes, killed and started again."""

import json
import os
import random
import shutil
import signal
import subprocess
import sys
import time
from pathlib import Path

import pytest
from lerobot.datasets.lerobot_dataset import LeRobotDataset

from lerobot_wm.collect.command import CollectConfig, collect, plan_shards
from lerobot_wm.collect.shards import SHARD_RECORD
from lerobot_wm.data.schema import COLLECTION_RECORD
from tests.extended.faults.killing import WatchedCommands, digests
from tests.extended.faults.running import processes_of, wait_until

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
    """SHA-256 of every file of the dataset, and its record without the wall time."""
    record = json.loads((root / COLLECTION_RECORD).read_text())
    del record["seconds"]
    return {**digests(root), str(COLLECTION_RECORD): json.dumps(record)}


@pytest.fixture(scope="module")
def collected(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """The shards as one process makes them in one go."""
    root = tmp_path_factory.mktemp("collected") / "dataset"
    config = CollectConfig(
        repo_id="user/small",
        root=root,
        tasks=TASKS,
        episodes_per_task=EPISODES,
        num_workers=1,
        shard="1/1",
    )
    return collect(config)


@pytest.fixture(scope="module")
def merging(collected: Path, commands: WatchedCommands) -> tuple[Path, list[str]]:
    """The dataset that is merged of them without disturbance, and the touches of that."""
    root = collected.with_name("merged") / "dataset"
    shutil.copytree(collected, root.with_name("dataset.shards"))
    commands.run(" ".join(command(root)[3:]), root.parent)
    return root, commands.touches


@pytest.fixture(scope="module")
def undisturbed(merging: tuple[Path, list[str]]) -> Path:
    """The dataset as it is made without disturbance."""
    return merging[0]


@pytest.mark.skipif(not Path("/proc").exists(), reason="looks for left-over processes in /proc")
def test_killed_and_started_again(undisturbed: Path, tmp_path: Path) -> None:
    """Two workers, killed when a shard is finished: nothing is lost, left over or different."""
    root, shards = tmp_path / "dataset", tmp_path / "dataset.shards"
    run = subprocess.Popen(command(root), process_group=0, stderr=subprocess.DEVNULL)
    wait_until(lambda: list(shards.glob(f"*-v3-00000/{SHARD_RECORD}")) or run.poll() is not None)
    assert run.poll() is None
    os.kill(run.pid, signal.SIGKILL)
    run.wait()
    wait_until(lambda: not processes_of(run.pid))  # workers end with their parent

    finished = [path.parent for path in shards.glob(f"*-v3-00000/{SHARD_RECORD}")]
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


@pytest.mark.skipif(not Path("/proc").exists(), reason="looks for left-over processes in /proc")
@pytest.mark.slow
def test_killed_at_random_moments(undisturbed: Path, tmp_path: Path) -> None:
    """All processes of a collection at once, again and again."""
    root, shards = tmp_path / "dataset", tmp_path / "dataset.shards"
    moments = random.Random(0)
    killed = 0
    while killed < 20:
        if killed_at_random(root, moments):
            killed += 1
            for shard in shards.glob("*-v3-00000"):
                assert LeRobotDataset("user/shard", root=shard).num_episodes == EPISODES
        if root.exists():  # killed at its very end, or it was faster
            assert contents(root) == contents(undisturbed)
            shutil.rmtree(root)
            shutil.rmtree(shards, ignore_errors=True)
    subprocess.run(command(root), check=True, capture_output=True)
    assert [path.name for path in tmp_path.iterdir()] == ["dataset"]
    assert contents(root) == contents(undisturbed)


def killed_at_random(root: Path, moments: random.Random) -> bool:
    """Go on with a collection, and kill its processes, unless they are faster, once one has begun a shard."""
    begun = set(root.parent.glob("dataset.shards/*.part"))
    start = time.monotonic()
    run = subprocess.Popen(command(root), process_group=0, stderr=subprocess.DEVNULL)
    wait_until(lambda: set(root.parent.glob("dataset.shards/*.part")) - begun or run.poll() is not None)
    time.sleep(moments.uniform(0, time.monotonic() - start))  # as slow as the machine is now
    if run.poll() is None:
        os.killpg(run.pid, signal.SIGKILL)
    wait_until(lambda: not processes_of(run.pid))
    return run.wait() == -signal.SIGKILL


@pytest.mark.parametrize("kills", [1, pytest.param(10, marks=pytest.mark.slow)])
def test_killed_while_it_merges(
    kills: int, merging: tuple[Path, list[str]], collected: Path, commands: WatchedCommands, tmp_path: Path
) -> None:
    expected, touches = merging
    arguments = " ".join(command(tmp_path / "dataset")[3:])
    for kill_at in random.Random(0).sample(range(len(touches)), kills):
        shutil.copytree(collected, tmp_path / "dataset.shards")
        assert commands.run(arguments, tmp_path, kill_at)
        commands.run(arguments, tmp_path)
        assert [path.name for path in tmp_path.iterdir()] == ["dataset"]
        assert contents(tmp_path / "dataset") == contents(expected)
        shutil.rmtree(tmp_path / "dataset")


def test_plan_covers_every_episode_once() -> None:
    shards = plan_shards(CollectConfig(repo_id="user/x", tasks="mt10", episodes_per_task=30))
    episodes = [(shard.task, e) for shard in shards for e in range(shard.first, shard.first + shard.count)]
    assert len(episodes) == len(set(episodes)) == 300
    assert len({shard.name for shard in shards}) == len(shards)
