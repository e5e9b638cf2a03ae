"""Our policy beside ACT and Diffusion Policy: the same demonstrations, the same training time, the same starts.

    python -m benchmarks.policies --task=pusht --root=data/pusht_human --minutes=30

The demonstrations of PushT are made by examples/pusht_human.py, those of ALOHA by examples/record_env.py, those of MT10
by `lerobot-wm collect`. A short run of each training tells how long it takes to start and how long a step takes, and so
how many steps fit. Everything is written to outputs/policies/<task>, and a repeated command keeps what is done.
Diffusion Policy needs `pip install 'diffusers>=0.38,<0.40'`.
"""

import argparse
import json
import os
import re
import shlex
import shutil
import subprocess
import sys
import time
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any

import numpy as np
import psutil
import torch
from lerobot.configs import FeatureType, PreTrainedConfig
from lerobot.datasets.dataset_metadata import LeRobotDatasetMetadata
from lerobot.datasets.lerobot_dataset import LeRobotDataset
from lerobot.policies.factory import get_policy_class, make_pre_post_processors
from rich.console import Console
from rich.table import Table

from benchmarks.measure import THREAD_VARIABLES
from lerobot_wm.files import write_whole
from lerobot_wm.policies.common.features import policy_features
from lerobot_wm.records import RNG_SEED, SuccessRate, percentile_interval, provenance, resample
from lerobot_wm.system import usable_cores

PILOT_STEPS = 20
LATENCY_FRAMES = 100
REPO_ID = "benchmark/demonstrations"


@dataclass(frozen=True)
class Training:
    """One training command.

    Attributes:
        flags: Of LeRobot's training, without data, steps, seed and output. {previous} is the training before it.
        share: Of the time that the policy may take.
        program: What is run.
    """

    flags: str
    share: float = 1.0
    program: str = "lerobot-wm train"


@dataclass(frozen=True)
class Task:
    """What is learned.

    Attributes:
        evaluation: Flags of lerobot-eval.
        trainings: By policy: its trainings, the last of which gives the policy.
    """

    evaluation: str
    trainings: dict[str, list[Training]]


def ours(share: float, world_model: str, policy: str) -> list[Training]:
    """A world model, and wm_bc on it; `share` of the time goes into the world model."""
    return [
        Training(f"--policy.type=wm_rssm --policy.rssm.standardize_images=true {world_model}", share),
        Training(
            "--policy.type=wm_bc --policy.world_model_path={previous} --policy.lr_decay_share=0.5 --batch_size=256 "
            f"{policy}",
            1 - share,
        ),
    ]


SMALL_BATCHES = (
    "--batch_size=4 --policy.window_length=16 --policy.rssm.decode_share=0.2 --policy.rssm.action_scale=2000"
)
KEYPOINTS = (
    "--batch_size=16 --policy.window_length=4 --policy.rssm.decode_share=0.5 --policy.rssm.action_scale=200 "
    "--policy.rssm.n_keypoints=64"
)
WIDE = "--policy.hidden_dims='[512,512,512]'"
# ImageNet's weights come from the network, and Diffusion Policy on PushT was published without them.
SCRATCH = "--policy.pretrained_backbone_weights=null"
ACT = [Training(f"--policy.type=act --batch_size=8 {SCRATCH}", program="lerobot-train")]


def diffusion(batch_size: int) -> list[Training]:
    """Diffusion Policy as LeRobot published it for PushT."""
    return [
        Training(
            f"--policy.type=diffusion --batch_size={batch_size} {SCRATCH} "
            "--policy.horizon=16 --policy.n_action_steps=8 "
            # 10 steps of DDIM: 100 of DDPM take minutes a decision for 25 rollouts on one core.
            "--policy.use_group_norm=true --policy.crop_ratio=0.875 "
            "--policy.noise_scheduler_type=DDIM --policy.num_inference_steps=10",
            program="lerobot-train",
        )
    ]


TASKS = {
    "pusht": Task(
        "--env.type=pusht --eval.batch_size=25",
        {
            "wm_bc": ours(
                0.65,
                f"{KEYPOINTS} --policy.rssm.kl_scale=0.1 --policy.rssm.action_horizon=16 "
                "--policy.lr_decay_share=0.5",
                "--policy.use_memory=false --policy.head=flow --policy.chunk_size=16 "
                f"--policy.n_action_steps=4 {WIDE}",
            ),
            "act": ACT,
            "diffusion": diffusion(64),
        },
    ),
    "aloha": Task(
        "--env.type=aloha --env.task=AlohaTransferCube-v0 --eval.batch_size=1",
        {
            "wm_bc": ours(
                0.85,
                f"{SMALL_BATCHES} --policy.rssm.kl_scale=0.3 --policy.rssm.hidden_action_share=0.5 "
                "--policy.rssm.image_shift=2 --policy.rssm.action_horizon=32 --policy.lr_decay_share=0.2",
                f"--policy.chunk_size=32 --policy.n_action_steps=16 {WIDE}",
            ),
            "act": ACT,
            "diffusion": diffusion(8),  # 64 images of 480x640 do not fit in 24 GB
        },
    ),
    "mt10": Task(
        "--env.type=metaworld_mt --env.task=mt10 --env.camera_name=hand_top,hand_side,gripperPOV "
        "--env.episode_length=500 --eval.batch_size=1",
        {
            "wm_bc": ours(
                0.85,
                f"{SMALL_BATCHES} --policy.rssm.kl_scale=0.3 --policy.rssm.reward_scale=100 "
                "--policy.rssm.hidden_action_share=0.5 --policy.rssm.image_shift=4 --policy.lr_decay_share=0.2",
                "",
            ),
            "act": ACT,
            "diffusion": diffusion(64),
        },
    ),
}


@dataclass(frozen=True)
class Run:
    """What a command needed.

    Attributes:
        command: As it was typed.
        seconds: It took.
        memory_gb: The highest sum of its processes' memory.
        output: What it printed.
    """

    command: str
    seconds: float
    memory_gb: float
    output: str


def run(command: str, threads: int, log: Path) -> Run:
    """Run a command of this environment.

    Raises:
        RuntimeError: It failed. Contains the end of what it printed.
    """
    log.parent.mkdir(parents=True, exist_ok=True)
    program, *arguments = shlex.split(command)
    start, peak = time.monotonic(), 0
    variables = {**os.environ, **dict.fromkeys(THREAD_VARIABLES, str(threads))}
    with log.open("w") as file:
        process = psutil.Popen(
            [str(Path(sys.executable).parent / program), *arguments],
            stdout=file,
            stderr=subprocess.STDOUT,
            env=variables,
        )
        while process.poll() is None:
            peak = max(peak, _memory(process))
            time.sleep(0.5)
    output = log.read_text()
    if process.returncode:
        raise RuntimeError(f"`{command}` failed:\n{output[-2000:]}")
    return Run(command, time.monotonic() - start, peak / 1e9, output)


def _memory(process: psutil.Process) -> int:
    try:
        return sum(each.memory_info().rss for each in (process, *process.children(recursive=True)))
    except psutil.NoSuchProcess:  # one has just ended
        return 0


def step_seconds(output: str) -> float:
    """How long a step takes, from the last line that LeRobot's training logged: its update and its data."""
    update, data = re.findall(r"updt_s:([\d.]+).*? data_s:([\d.]+)", output)[-1]
    return float(update) + float(data)


def train(training: Training, flags: str, minutes: float, threads: int, folder: Path) -> dict[str, Any]:
    """Train for about so many minutes, including the start and what comes before the first step.

    Returns:
        The `Run` without its output, from `folder`.json if that training was done before.
    """
    done = folder.with_suffix(".json")
    if done.exists():
        return json.loads(done.read_text())
    command = f"{training.program} {training.flags} {flags}"
    for path in (folder, Path(f"{folder}_pilot")):  # of a training that was stopped
        shutil.rmtree(path, ignore_errors=True)
    pilot = run(
        f"{command} --steps={PILOT_STEPS} --log_freq={PILOT_STEPS // 2} --save_checkpoint=false "
        f"--output_dir={folder}_pilot",
        threads,
        folder.with_name(f"{folder.name}_pilot.log"),
    )
    step = step_seconds(pilot.output)
    begin = pilot.seconds - PILOT_STEPS * step
    steps = max(1, int((60 * minutes - begin) / step))
    print(f"{folder.name}: {begin:.0f} s to start, {step:.3f} s a step: {steps} steps", flush=True)
    whole = run(
        f"{command} --steps={steps} --save_freq={steps} --output_dir={folder}",
        threads,
        folder.with_name(f"{folder.name}.log"),
    )
    record = {key: value for key, value in asdict(whole).items() if key != "output"}
    write_whole(done, json.dumps(record, indent=2) + "\n")
    return record


def latency(checkpoint: Path, root: Path) -> dict[str, float]:
    """The mean and the longest time of a decision in ms, on one thread, over the first frames of the dataset."""
    torch.set_num_threads(1)
    config = PreTrainedConfig.from_pretrained(checkpoint)
    config.device = "cpu"
    policy = get_policy_class(config.type).from_pretrained(checkpoint, config=config)
    before, _ = make_pre_post_processors(config, str(checkpoint))
    dataset = LeRobotDataset(REPO_ID, root)
    frames = [
        {key: value for key, value in dataset[index].items() if key in (*config.input_features, "task")}
        for index in range(LATENCY_FRAMES)
    ]

    def decision_ms(frame: dict[str, Any]) -> float:
        begin = time.perf_counter()
        with torch.inference_mode():
            policy.select_action(before(frame))
        return 1000 * (time.perf_counter() - begin)

    decision_ms(frames[0])  # warms up
    policy.reset()
    times = [decision_ms(frame) for frame in frames]
    return {"mean": float(np.mean(times)), "longest": float(np.max(times))}


def inputs(root: Path) -> dict[str, Any]:
    """What a policy may read: cameras and proprioception. LeRobot's would read the simulator's full state too."""
    features = policy_features(LeRobotDatasetMetadata(REPO_ID, root))
    return {
        key: {"type": feature.type.name, "shape": list(feature.shape)}
        for key, feature in features.items()
        if feature.type in (FeatureType.VISUAL, FeatureType.STATE)
    }


def measure(task: Task, policy: str, arguments: argparse.Namespace, folder: Path) -> dict[str, Any]:
    """Train and evaluate one policy."""
    flags = f"--dataset.repo_id={REPO_ID} --dataset.root={arguments.root} --seed={arguments.seed}"
    flags += " --policy.push_to_hub=false --policy.device=cpu"
    peers = f" --policy.input_features={shlex.quote(json.dumps(inputs(arguments.root)))}"
    runs, previous = [], Path()
    for number, training in enumerate(task.trainings[policy]):
        output = folder / f"{policy}_{number}"
        filled = Training(training.flags.format(previous=previous), training.share, training.program)
        own = flags if training.program == "lerobot-wm train" else flags + peers
        runs.append(train(filled, own, arguments.minutes * training.share, arguments.threads, output))
        previous = output / "checkpoints" / "last" / "pretrained_model"
    evaluation = folder / f"{policy}_eval"
    run(
        f"lerobot-eval --policy.path={previous} --policy.device=cpu {task.evaluation} --eval.use_async_envs=false "
        f"--eval.n_episodes={arguments.episodes} --seed={arguments.first_start} --output_dir={evaluation}",
        arguments.threads,
        folder / f"{policy}_eval.log",
    )
    infos = json.loads((evaluation / "eval_info.json").read_text())["per_task"]
    return {
        "policy": policy,
        "trainings": runs,
        "minutes": sum(each["seconds"] for each in runs) / 60,
        "memory_gb": max(each["memory_gb"] for each in runs),
        "latency_ms": latency(previous, arguments.root),
        "successes": [bool(each) for each in by_start(infos, "successes")],
        "max_rewards": [float(each) for each in by_start(infos, "max_rewards")],
    }


def by_start(infos: list[dict[str, Any]], metric: str) -> list[Any]:
    """A metric of every episode: each task's first start, then each task's second, and so on.

    So the starts of a run with fewer episodes are the first ones of a run with more.

    Args:
        infos: Of each task, what lerobot-eval measured.
        metric: Its name.
    """
    starts = zip(*(info["metrics"][metric] for info in infos), strict=True)
    return [value for of_start in starts for value in of_start]


def difference(ours: list[bool], other: list[bool]) -> str:
    """Success of ours minus another's in points, with its 95% interval over the starts that both have."""
    n = min(len(ours), len(other))
    each = 100 * (np.array(ours[:n], dtype=float) - np.array(other[:n], dtype=float))  # (n,)
    low, high = percentile_interval(resample(each, np.random.default_rng(RNG_SEED)).mean(axis=1))
    return f"{each.mean():+.0f} [{low:+.0f}, {high:+.0f}]"


def results_table(rows: list[dict[str, Any]]) -> Table:
    """One line per policy; the first is ours."""
    table = Table("policy", "success", "ours minus it", "best reward", "training", "memory", "decision")
    for row in rows:
        successes = row["successes"]
        table.add_row(
            row["policy"],
            str(SuccessRate(sum(successes), len(successes))),
            "" if row is rows[0] else difference(rows[0]["successes"], successes),
            f"{np.mean(row['max_rewards']):.3f}",
            f"{row['minutes']:.0f} min",
            f"{row['memory_gb']:.1f} GB",
            f"{row['latency_ms']['mean']:.1f} ms, at most {row['latency_ms']['longest']:.0f}",
        )
    return table


def main() -> None:
    """Measure all policies of one task."""
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("--task", choices=TASKS, required=True)
    parser.add_argument("--root", type=Path, required=True, help="folder of the demonstrations")
    parser.add_argument("--minutes", type=float, default=30, help="of training, for each policy")
    parser.add_argument("--policies", default="wm_bc,act,diffusion", help="names, separated by commas")
    parser.add_argument("--episodes", type=int, default=50, help="of evaluation")
    parser.add_argument("--first_start", type=int, default=1000, help="seed of the first evaluated start")
    parser.add_argument("--seed", type=int, default=0, help="of training")
    parser.add_argument("--threads", type=int, default=usable_cores(), help="of every command")
    parser.add_argument("--output_dir", type=Path, help="default: outputs/policies/<task>")
    arguments = parser.parse_args()
    task = TASKS[arguments.task]
    folder = arguments.output_dir or Path("outputs") / "policies" / arguments.task
    rows = []
    for policy in arguments.policies.split(","):
        path = folder / f"{policy}.json"
        if not path.exists():
            row = {"provenance": provenance(), **measure(task, policy, arguments, folder)}
            write_whole(path, json.dumps(row, indent=2) + "\n")
        rows.append(json.loads(path.read_text()))
    Console().print(results_table(rows))


if __name__ == "__main__":
    main()
