"""Check that memory, open files, threads and OpenGL contexts do not grow over a long run.

    python results/faults/long_run.py --output=results/faults/long_run.json

Trains a policy with `lerobot-wm train` on two short episodes, so that a new epoch begins every few steps. Then resets
the environments of the paper's six tasks in turn in one process, and sometimes creates them again. Compares what the
processes hold after a warm-up with what they hold at the end.
"""

import argparse
import gc
import json
import statistics
import subprocess
import sys
import tempfile
import time
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any

import numpy as np
import psutil

from lerobot_wm.constants import MT6
from lerobot_wm.envs.metaworld_mt import MetaworldMTEnv
from lerobot_wm.envs.rendering import Renderer
from lerobot_wm.records import provenance

WARM_UP = 0.2  # share of a run that covers imports, the allocator's pools and the first checkpoint
RESETS_PER_ENV = 240  # then the environments are closed and created again
SECONDS_BETWEEN_SAMPLES = 1.0


@dataclass(frozen=True)
class Sample:
    """Resident memory (MB), open files and threads of a process."""

    memory: float
    files: int
    threads: int

    @classmethod
    def of(cls, process: psutil.Process) -> "Sample":
        """Sample a running process.

        Raises:
            psutil.Error: The process has ended.
        """
        with process.oneshot():
            return cls(process.memory_info().rss / 1e6, process.num_fds(), process.num_threads())


def compare(samples: list[Sample]) -> dict[str, Any]:
    """Compare medians of the tenth of the samples after the warm-up with medians of the last tenth."""
    tenth = max(1, len(samples) // 10)
    first = int(WARM_UP * len(samples))
    parts = {"after warm-up": samples[first : first + tenth], "at the end": samples[-tenth:]}
    medians = {
        part: {
            name: statistics.median(asdict(sample)[name] for sample in of_part) for name in asdict(samples[0])
        }
        for part, of_part in parts.items()
    }
    before, after = (part["memory"] for part in medians.values())
    return {**medians, "growth of memory": round(after / before - 1, 4), "samples": len(samples)}


def train(folder: Path, steps: int) -> dict[str, Any]:
    """Train a small policy for many epochs in a subprocess and sample it every second."""
    lerobot_wm = [sys.executable, "-m", "lerobot_wm.cli"]
    dataset = [f"--root={folder / 'dataset'}", "--repo_id=local/long_run"]
    collect = ["collect", "--tasks=reach-v3", "--episodes_per_task=2", "--image_size=32", "--num_workers=1"]
    subprocess.run([*lerobot_wm, *collect, *dataset], check=True)
    command = [
        *(*lerobot_wm, "train", "--policy.type=e2e_bc", "--policy.device=cpu", "--policy.push_to_hub=false"),
        *("--policy.encoder_image_size=[32,32]", "--policy.dtype=float32", "--batch_size=8"),
        *(f"--steps={steps}", "--log_freq=100", f"--save_freq={max(1, steps // 10)}", "--num_workers=0"),
        *(f"--dataset.root={folder / 'dataset'}", "--dataset.repo_id=local/long_run"),
        f"--output_dir={folder / 'run'}",
    ]
    start = time.monotonic()
    samples: list[Sample] = []
    with (folder / "train.log").open("w") as log:
        run = subprocess.Popen(command, stdout=log, stderr=subprocess.STDOUT)
        while run.poll() is None:
            if (folder / "run" / "train_log.jsonl").exists():  # training has begun
                samples.append(Sample.of(psutil.Process(run.pid)))
            time.sleep(SECONDS_BETWEEN_SAMPLES)
    if run.returncode != 0:
        raise RuntimeError(f"Training failed: {(folder / 'train.log').read_text()[-2000:]}")
    last = json.loads((folder / "run" / "train_log.jsonl").read_text().splitlines()[-1])
    seconds = round(time.monotonic() - start)
    return {"steps": last["step"], "epochs": round(last["epochs"]), "seconds": seconds, **compare(samples)}


def reset(resets: int) -> dict[str, Any]:
    """Reset the environments of the six tasks in turn in this process, with one step each."""
    envs = [MetaworldMTEnv(task) for task in MT6]
    action = np.zeros(4, np.float32)
    process = psutil.Process()
    start = time.monotonic()
    samples, contexts = [], set()
    for i in range(resets):
        env = envs[i % len(envs)]
        env.reset(seed=i // len(envs))
        env.step(action)
        if i % RESETS_PER_ENV == RESETS_PER_ENV - 1:
            contexts.add(count_contexts())
            for env in envs:
                env.close()
            contexts.add(count_contexts())
        samples.append(Sample.of(process))
    for env in envs:
        env.close()
    seconds = round(time.monotonic() - start)
    return {"resets": resets, "seconds": seconds, "contexts": sorted(contexts), **compare(samples)}


def count_contexts() -> int:
    """Count the renderers of this process; each has one OpenGL context."""
    gc.collect()
    return sum(type(thing) is Renderer for thing in gc.get_objects())


def main() -> None:
    """Run both, print and write the samples."""
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("--steps", type=int, default=20_000, help="training steps")
    parser.add_argument("--resets", type=int, default=2_000)
    parser.add_argument("--output", type=Path, required=True)
    arguments = parser.parse_args()
    rows = {"resets": reset(arguments.resets)}
    print(rows, flush=True)
    with tempfile.TemporaryDirectory() as folder:
        rows["training"] = train(Path(folder), arguments.steps)
    print(rows["training"])
    arguments.output.parent.mkdir(parents=True, exist_ok=True)
    arguments.output.write_text(json.dumps({"rows": rows, "provenance": provenance()}, indent=2) + "\n")


if __name__ == "__main__":
    main()
