"""A Hub on this machine, and a machine that talks to no other."""

import itertools
import json
import os
import subprocess
import sys
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path

import pytest

from tests.extended.hub.server import Hub, serve
from tests.flags import SMALL_WORLD_MODEL

ROOT = Path(__file__).parents[3]
TRAIN = "--policy.device=cpu --policy.push_to_hub=true --batch_size=2 --steps=2 --log_freq=1 --seed=3 --num_workers=0"
USERS = {"write-user": "user", "read-user": "user", "write-other": "other"}


@dataclass
class Result:
    """What a command left: its exit status, and all it printed."""

    status: int
    output: str

    @property
    def lines(self) -> list[str]:
        return self.output.strip().splitlines()


class Machine:
    """Runs commands in processes of their own, see tests/extended/hub/commands.py."""

    def __init__(self, url: str, folder: Path) -> None:
        self.folder = folder
        self._numbers = itertools.count()
        env = {key: value for key, value in os.environ.items() if not key.startswith("HF_")}
        env |= {"HF_ENDPOINT": url, "HF_HOME": str(folder / "home"), "HF_HUB_DISABLE_XET": "1"}
        self._process = subprocess.Popen(
            [sys.executable, str(Path(__file__).with_name("commands.py"))],
            cwd=ROOT,
            env={**env, "LEROBOT_WM_CACHE": str(folder / "cache"), "OMP_NUM_THREADS": "1"},
            stdin=subprocess.PIPE,
            stdout=subprocess.PIPE,
            text=True,
        )
        assert self._process.stdout.readline() == "ready\n"

    def run(self, *arguments: str, token: str = "write-user", empty_home: bool = False) -> Result:
        """Run `lerobot-wm ARGUMENTS`; each may hold several flags separated by spaces."""
        return self._request({"arguments": " ".join(arguments).split()}, token, empty_home)

    def python(self, code: str, token: str = "", empty_home: bool = False) -> Result:
        """Run a program."""
        return self._request({"python": code}, token, empty_home)

    def close(self) -> None:
        self._process.stdin.close()
        self._process.wait()

    def _request(self, request: dict, token: str, empty_home: bool) -> Result:
        output = self.folder / f"output_{next(self._numbers)}.txt"
        env = {"HF_TOKEN": token}
        request |= {"env": env, "output": str(output), "empty_home": empty_home}
        self._process.stdin.write(json.dumps(request) + "\n")
        self._process.stdin.flush()
        return Result(int(self._process.stdout.readline()), output.read_text())


@pytest.fixture(scope="session")
def hub(tmp_path_factory: pytest.TempPathFactory) -> Iterator[Hub]:
    """The Hub, empty at first; its state may be looked at."""
    hub = Hub(tmp_path_factory.mktemp("hub"), USERS)
    server = serve(hub)
    yield hub
    server.shutdown()


@pytest.fixture(scope="session")
def machine(hub: Hub, tmp_path_factory: pytest.TempPathFactory) -> Iterator[Machine]:
    """Another machine than the one the fixtures of tests/conftest.py work on."""
    machine = Machine(hub.url, tmp_path_factory.mktemp("machine"))
    yield machine
    machine.close()


def read(hub: Hub, kind: str, repo_id: str, path: str) -> bytes:
    """A file of a repository's main branch."""
    return hub.content(hub.repos[kind, repo_id].files()[path])


@pytest.fixture(scope="session")
def collect(demos_root: Path) -> str:
    """The command that collected the demonstrations, which publishes them as user/demos now that they are there."""
    return (
        "collect --tasks=reach-v3,window-close-v3 --episodes_per_task=4 --variations=0-9 --noise=0.3 --seed=0 "
        f"--repo_id=user/demos --root={demos_root} --push_to_hub=true"
    )


@pytest.fixture(scope="session")
def demos_commit(hub: Hub, machine: Machine, collect: str) -> str:
    """The demonstrations are published: the commit that LeRobot's version tag points to."""
    result = machine.run(collect)
    assert result.status == 0, result.output
    return hub.repos["dataset", "user/demos"].tags["v3.0"]


@pytest.fixture(scope="session")
def runs(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Where trainings write."""
    return tmp_path_factory.mktemp("runs")


@pytest.fixture(scope="session")
def world_model_commit(hub: Hub, machine: Machine, demos_commit: str, runs: Path) -> str:
    """A world model trained on user/demos is published as user/wm: its commit."""
    result = machine.run(
        f"train --policy.type=wm_rssm {SMALL_WORLD_MODEL} {TRAIN} --policy.repo_id=user/wm",
        f"--dataset.repo_id=user/demos --dataset.revision={demos_commit} --output_dir={runs / 'wm'}",
        empty_home=True,
    )
    assert result.status == 0, result.output
    return hub.repos["model", "user/wm"].branches["main"]


@pytest.fixture(scope="session")
def checkpoints(hub: Hub, machine: Machine, world_model_commit: str, runs: Path) -> dict[str, Path]:
    """The world model, and a wm_iql trained on it and user/demos by their names and published as user/wm_iql."""
    repo = hub.repos["model", "user/wm"]
    hub.commit(repo, "main", repo.files() | {"model.safetensors": hub.store(b"what the pin is to keep away")})
    result = machine.run(
        f"train --policy.type=wm_iql --policy.world_model_path=user/wm@{world_model_commit} {TRAIN}",
        f"--policy.repo_id=user/wm_iql --dataset.repo_id=user/demos --output_dir={runs / 'wm_iql'}",
        empty_home=True,
    )
    assert result.status == 0, result.output
    repo.branches["main"] = world_model_commit
    return {f"user/{name}": runs / name / "checkpoints/last/pretrained_model" for name in ("wm", "wm_iql")}
