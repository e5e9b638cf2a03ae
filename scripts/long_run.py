"""Whether memory, open files, threads or OpenGL contexts grow: a training of many short epochs, and many resets.

    python scripts/long_run.py --output=results/faults/long_run.json

A policy is trained by `lerobot-wm train` on two short episodes, a new epoch every few steps, and the environments of
the paper's six tasks are reset in turn in one process, made anew now and then. What is there after a warm-up is
compared with what is there at the end.
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

WARM_UP = 0.2  # of a run; imports, the allocator's pools, the first checkpoint
MADE_ANEW = 240  # resets after which environments are closed and made again
SECONDS_BETWEEN_SAMPLES = 1.0


@dataclass(frozen=True)
class Sample:
    """What a process holds: resident memory (MB), open files, threads."""

    memory: float
    files: int
    threads: int

    @classmethod
    def of(cls, process: psutil.Process) -> "Sample":
        """Look at a living process.

        Raises:
            psutil.Error: It has ended.
        """
        with process.oneshot():
            return cls(process.memory_info().rss / 1e6, process.num_fds(), process.num_threads())


def compared(samples: list[Sample]) -> dict[str, Any]:
    """Medians of the tenth of the samples that follows the warm-up, and of the last tenth; growth of memory between."""
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
    """Train a small policy for many epochs in a process of its own, and watch it."""
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
            if (folder / "run" / "train_log.jsonl").exists():  # steps are being taken
                samples.append(Sample.of(psutil.Process(run.pid)))
            time.sleep(SECONDS_BETWEEN_SAMPLES)
    if run.returncode != 0:
        raise RuntimeError(f"the training failed: {(folder / 'train.log').read_text()[-2000:]}")
    last = json.loads((folder / "run" / "train_log.jsonl").read_text().splitlines()[-1])
    seconds = round(time.monotonic() - start)
    return {"steps": last["step"], "epochs": round(last["epochs"]), "seconds": seconds, **compared(samples)}


def reset(resets: int) -> dict[str, Any]:
    """Reset the environments of the six tasks in turn, one step each, in this process."""
    envs = [MetaworldMTEnv(task) for task in MT6]
    action = np.zeros(4, np.float32)
    process = psutil.Process()
    start = time.monotonic()
    samples, contexts = [], set()
    for i in range(resets):
        env = envs[i % len(envs)]
        env.reset(seed=i // len(envs))
        env.step(action)
        if i % MADE_ANEW == MADE_ANEW - 1:
            contexts.add(living_contexts())
            for env in envs:
                env.close()
            contexts.add(living_contexts())
        samples.append(Sample.of(process))
    for env in envs:
        env.close()
    seconds = round(time.monotonic() - start)
    return {"resets": resets, "seconds": seconds, "contexts": sorted(contexts), **compared(samples)}


def living_contexts() -> int:
    """Renderers of this process, each with its context of MuJoCo's in OpenGL's memory."""
    gc.collect()
    return sum(type(thing) is Renderer for thing in gc.get_objects())


def main() -> None:
    """Run both and write what they held."""
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("--steps", type=int, default=20_000, help="of training")
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
