"""Commands in processes of their own, that can be interrupted, run side by side and on a disk of any size."""

import json
import os
import signal
import subprocess
import sys
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from lerobot_wm.envs.tasks import task_description
from tests.flags import SMALL_WORLD_MODEL, TRAIN_FLAGS
from tests.recording import camera, record, vector

SERVER = Path(__file__).with_name("serving.py")


@dataclass(frozen=True)
class Ended:
    """How a command ended: its exit code, -n where signal n ended it, and all that it printed."""

    code: int
    printed: str

    @property
    def last_line(self) -> str:
        """The last line it printed."""
        return self.printed.strip().splitlines()[-1]


class Running:
    """A command at work, in a process group of its own."""

    def __init__(self, pid: int, output: Path, ask: Callable[[dict[str, Any]], Any]) -> None:
        self._pid = pid
        self._output = output
        self._ask = ask

    @property
    def processes(self) -> list[int]:
        """Its own and those of its workers that live."""
        return processes_of(self._pid)

    def interrupt_when(self, condition: Callable[[], object]) -> Ended:
        """Wait for a condition, then do what Ctrl-C does: interrupt every process of the group."""
        wait_until(lambda: condition() or not self.processes)
        os.killpg(self._pid, signal.SIGINT)
        return self.wait()

    @contextmanager
    def paused(self) -> Iterator[None]:
        """Stand still meanwhile."""
        os.killpg(self._pid, signal.SIGSTOP)
        try:
            yield
        finally:
            os.killpg(self._pid, signal.SIGCONT)

    def wait(self) -> Ended:
        """Wait for its end, and for that of its workers."""
        code = self._ask({"wait": self._pid})
        # The server that workers are forked from ends after its parent, each with seconds of tidying up.
        wait_until(lambda: not self.processes)
        return Ended(code, self._output.read_text())


class Commands:
    """Starts `lerobot-wm` commands.

    Args:
        folder: For what they print.
    """

    def __init__(self, folder: Path) -> None:
        self._folder = folder
        self._count = 0
        self._server = subprocess.Popen(
            [sys.executable, SERVER], stdin=subprocess.PIPE, stdout=subprocess.PIPE, text=True
        )

    def start(self, *arguments: str, **environment: str) -> Running:
        """Start a command; arguments may hold several flags separated by spaces."""
        self._count += 1
        output = self._folder / f"{self._count}.txt"
        words = " ".join(arguments).split()
        pid = self._ask({"run": words, "environment": environment, "output": str(output)})
        return Running(pid, output, self._ask)

    def run(self, *arguments: str, **environment: str) -> Ended:
        """Run a command to its end."""
        return self.start(*arguments, **environment).wait()

    def close(self) -> None:
        """End the server."""
        self._server.communicate(timeout=30)

    def _ask(self, request: dict[str, Any]) -> Any:
        assert self._server.stdin is not None
        assert self._server.stdout is not None
        print(json.dumps(request), file=self._server.stdin, flush=True)
        return json.loads(self._server.stdout.readline())


def wait_until(condition: Callable[[], object], seconds: float = 240.0) -> None:
    """Look at a condition until it holds."""
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


@contextmanager
def small_disk(place: Path, size: str) -> Iterator[Path]:
    """A file system in memory, of a size such as 300k, mounted at a folder; skips the test where none can be had."""
    place.mkdir()
    mounted = subprocess.run(
        ["mount", "-t", "tmpfs", "-o", f"size={size}", "tmpfs", place], capture_output=True
    )
    if mounted.returncode != 0:
        pytest.skip("no disk can be mounted here: that takes root")
    try:
        yield place
    finally:
        subprocess.run(["umount", "--lazy", place], check=True)


def remount(place: Path, options: str) -> None:
    """Change a mounted disk: ro, rw or size=..."""
    subprocess.run(["mount", "-o", f"remount,{options}", place], check=True)


@dataclass(frozen=True)
class Inputs:
    """What the commands read: a dataset of noise, an untrained world model, its latents, and a policy on them."""

    dataset: Path
    world_model: Path
    latents: Path
    policy: Path

    def command(self, name: str, output: Path, workers: int = 1) -> str:
        """A command that works for a few seconds, with its flags, into a folder.

        With two workers, `collect` and `eval` do twice as much, each worker one task.
        """
        tasks = ",".join(("reach-v3", "window-close-v3")[:workers])
        dataset = f"--dataset.repo_id=test/noise --dataset.root={self.dataset}"
        match name:
            case "collect":
                sizes = f"--tasks={tasks} --episodes_per_task=1 --steps_after_success=0 --image_size=16"
                return f"collect {sizes} --num_workers={workers} --repo_id=a/b --root={output}"
            case "encode":
                path = f"--world_model_path={self.world_model} --device=cpu"
                return f"encode {path} {dataset} --output_repo_id=a/b --output_root={output}"
            case "train":
                sizes = (
                    f"--policy.window_length=4 --batch_size=2 --save_freq=3 --log_freq=1 {SMALL_WORLD_MODEL}"
                )
                return f"train --policy.type=wm_rssm {sizes} {TRAIN_FLAGS} {dataset} --output_dir={output}"
            case _:
                env = f"--env.type=metaworld_mt --env.task={tasks} --env.episode_length=20"
                rollouts = f"--eval.n_episodes=2 --seed=0 --num_workers={workers}"
                return f"eval --policy.path={self.policy} --policy.device=cpu {env} {rollouts} --output_dir={output}"


def make_inputs(commands: Commands, folder: Path) -> Inputs:
    """Record the dataset, train the models for a step, encode."""
    features = {
        "observation.image": camera(64, 64),
        **{"observation.state": vector(4), "action": vector(4)},
        **{"next.reward": vector(1), "next.done": vector(1, "bool")},
    }
    episodes = [(task_description("reach-v3"), 6)] * 18  # encoded in two batches
    record(folder / "noise", features, episodes, lambda t, length: {"next.done": np.array([t == length - 1])})
    last = Path("checkpoints") / "last" / "pretrained_model"
    inputs = Inputs(folder / "noise", folder / "wm" / last, folder / "latents", folder / "bc" / last)
    of_latents = f"--dataset.repo_id=a/b --dataset.root={inputs.latents} --policy.world_model_path={inputs.world_model}"
    for arguments in (
        f"{inputs.command('train', folder / 'wm')} --steps=1",
        inputs.command("encode", inputs.latents),
        f"train --policy.type=wm_bc --steps=1 {TRAIN_FLAGS} {of_latents} --output_dir={folder / 'bc'}",
    ):
        ended = commands.run(arguments)
        assert ended.code == 0, ended.printed
    return inputs
