"""Few-shot transfer: policies for five tasks that the world model has not seen, from a few demonstrations of each.

    python results/few_shot/few_shot.py --list
    python results/few_shot/few_shot.py --arms=frozen,scratch --demonstrations=1,5 --seeds=0

A world model learns from ML45's 45 training tasks, and one policy from N demonstrations of each of its five test tasks,
all on different positions. Policies are rolled out on other positions of each task. The demonstrations are those of
`lerobot-wm experiment --preset=mt50_hand`. A repeated command keeps what is finished and resumes the rest.
"""

import argparse
import json
import sys
from collections.abc import Iterable
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any, Literal

from lerobot.common.train_utils import get_step_checkpoint_dir
from lerobot.configs.train import TRAIN_CONFIG_NAME
from lerobot.utils.constants import OPTIMIZER_PARAM_GROUPS, PRETRAINED_MODEL_DIR, TRAINING_STATE_DIR
from rich.console import Console

from lerobot_wm.constants import ENV_TYPE, ML45_TEST, RECORDS_NAME
from lerobot_wm.envs.tasks import all_tasks, resolve_tasks
from lerobot_wm.experiment.plan import Plan
from lerobot_wm.experiment.preset import load_preset
from lerobot_wm.experiment.runner import Runner, Times, minutes_text
from lerobot_wm.experiment.stage import Checkpoint, Dataset, Stage, in_order, lerobot_wm, unfinished
from lerobot_wm.files import sole_writer
from lerobot_wm.report.arms import TRAININGS
from lerobot_wm.system import usable_cores
from lerobot_wm.train.resume import can_resume

FULL_STATE = "full_state"  # the control that sees no image and is told where everything is
MT50 = load_preset("mt50_hand")


@dataclass(frozen=True)
class Step:
    """A command that makes a checkpoint.

    Args:
        kind: What it makes. Two arms whose steps are equal so far share them.
        flags: Of `lerobot-wm train`. {previous} is the checkpoint of the step before.
        steps: Of the training; 0 for `lerobot-wm init`, which trains nothing.
        minutes: It takes about so long, until one of its kind was measured.
        data: All demonstrations of the training tasks, N of each test task, or these and a fifth as many of each
            training task, at least one.
    """

    kind: str
    flags: str
    steps: int
    minutes: float
    data: Literal["training tasks", "test tasks", "both"] = "test tasks"


def policy_flags(settings: dict[str, Any], prefix: str = "policy") -> str:
    """The flags of a policy's settings, which may be nested."""
    return " ".join(
        policy_flags(value, f"{prefix}.{name}")
        if isinstance(value, dict)
        else f"--{prefix}.{name}={json.dumps(value)}".replace('"', "")
        for name, value in settings.items()
    )


# The settings of the preset, so that its demonstrations and its world model go together.
UNTRAINED_MODEL = policy_flags(MT50.trainings["wm_rssm"]["policy"])
WORLD_MODEL = f"{UNTRAINED_MODEL} --batch_size={MT50.trainings['wm_rssm']['batch_size']}"
BC = "--policy.lr_decay_share=0.5 --batch_size=256"
ON_LATENTS = f"--policy.type=wm_bc --policy.world_model_path={{previous}} {BC}"
ON_IMAGES = "--policy.random_crop_pad=4 --policy.lr_decay_share=0.5 --batch_size=128"
# Single frames: memory harms in tasks that the world model has not seen (README.md).
JOINTLY = f"{policy_flags(TRAININGS['joint_bc'])} --policy.world_model_path={{previous}} {ON_IMAGES}"
FROM_IMAGES = f"--policy.type=e2e_bc {ON_IMAGES}"

PRETRAINED = Step("pretrained", WORLD_MODEL, 10_000, 20, "training tasks")
UNTRAINED = Step("untrained", UNTRAINED_MODEL, 0, 0.3)
POLICY = Step(
    "policy",
    f"{ON_LATENTS} --policy.random_crop_pad=4 --policy.use_memory=false --policy.dropout=0.5",
    6_000,
    2,
)
JOINT = Step("joint", JOINTLY, 3_000, 6)
JOINT_ON = Step("joint_on", f"--policy.path={{previous}} {ON_IMAGES}", 2_000, 5)
TOGETHER = Step("together", JOINT_ON.flags, 4_000, 7, "both")
ALL_JOINT = Step("all_joint", JOINTLY, 10_000, 15, "training tasks")
ALL_SCRATCH = Step("all_scratch", FROM_IMAGES, 10_000, 15, "training tasks")
# The policies of the test tasks, each the last of its steps.
ARMS = {
    "frozen": [PRETRAINED, POLICY],
    "fine_tuned": [
        PRETRAINED,
        Step("fine_tuned", "--policy.path={previous} --policy.lr=3e-4 --batch_size=4", 2_000, 4),
        POLICY,
    ],
    "joint": [PRETRAINED, JOINT],
    "joint_untrained": [UNTRAINED, JOINT],
    "policy": [
        PRETRAINED,
        Step("all_tasks", ON_LATENTS, 40_000, 15, "training tasks"),
        Step("policy_on", f"--policy.path={{previous}} {BC}", 6_000, 2),
    ],
    "policy_joint": [PRETRAINED, ALL_JOINT, JOINT_ON],
    "policy_scratch": [ALL_SCRATCH, JOINT_ON],
    "together_joint": [PRETRAINED, ALL_JOINT, TOGETHER],
    "together_scratch": [ALL_SCRATCH, TOGETHER],
    "together_untrained": [replace(TOGETHER, kind="together_untrained", flags=FROM_IMAGES)],
    "demonstrations_only": [Step("world_model", WORLD_MODEL, 6_000, 12), POLICY],
    "scratch": [Step("scratch", FROM_IMAGES, 3_000, 6)],
    "backbone": [
        Step("backbone", "--policy.type=frozen_backbone --policy.backbone=resnet18", 0, 0.3),
        POLICY,
    ],
    "untrained": [UNTRAINED, POLICY],
    "proprioception": [Step("proprioception", f"{policy_flags(TRAININGS['proprio_bc'])} {BC}", 6_000, 2)],
    FULL_STATE: [Step(FULL_STATE, f"{policy_flags(TRAININGS['state_bc'])} {BC}", 6_000, 1)],
}
MINUTES = {step.kind: step.minutes for arm in ARMS.values() for step in arm}
MINUTES |= {"collect": MT50.minutes["collect"], "evaluate": 5}


def pretraining_tasks(count: int) -> list[str]:
    """Of ML45's training tasks, so many.

    They are spread over the alphabet, in which tasks that resemble each other are neighbours.
    """
    ml45 = resolve_tasks("ml45")
    return [ml45[i * len(ml45) // count] for i in range(count)]


def first_of_each(tasks: Iterable[str], count: int) -> list[int]:
    """The first `count` episodes of each task in the preset's demonstrations, in ascending order."""
    firsts = sorted(all_tasks().index(task) * MT50.episodes_per_task for task in tasks)
    return [first + episode for first in firsts for episode in range(count)]


@dataclass(frozen=True)
class Transfer:
    """Builds the stages of the arms.

    Args:
        demonstrations: Of all tasks.
        output_dir: Where everything else is written.
        n_tasks: How many of the 45 training tasks the world model sees.
        n_demonstrations: Of each test task.
        seed: Of all training.
        variation_set: That policies are rolled out on.
        n_rollouts: Of each test task.
    """

    demonstrations: Dataset
    output_dir: Path
    n_tasks: int
    n_demonstrations: int
    seed: int
    variation_set: int
    n_rollouts: int

    def tasks_seen(self, steps: list[Step]) -> int:
        """How many of the training tasks were learned by these steps."""
        return self.n_tasks if any(step.data != "test tasks" for step in steps) else 0

    def episodes(self, step: Step) -> list[int]:
        """What a step is trained on."""
        training = pretraining_tasks(self.n_tasks)
        if step.data == "training tasks":
            return first_of_each(training, MT50.episodes_per_task)
        of_old_tasks = max(1, self.n_demonstrations // 5) if step.data == "both" else 0
        return first_of_each(ML45_TEST, self.n_demonstrations) + first_of_each(training, of_old_tasks)

    def checkpoint(self, steps: list[Step]) -> Checkpoint:
        """What the last of these steps makes."""
        *before, step = steps
        previous = self.checkpoint(before) if before else None
        kinds = "-".join(each.kind for each in steps)
        seen = f"{self.tasks_seen(steps)}_tasks"
        if step.steps and step.data != "training tasks":
            seen += f"/{self.n_demonstrations}_demonstrations"
        name = f"{seen}/{kinds}_{self.seed}"
        folder = self.output_dir / name
        needs = (self.demonstrations.made_by, *([previous.made_by] if previous else []))
        flags = step.flags.format(previous=previous and previous.path).split()
        settings = {**self.demonstrations.flags(), "seed": self.seed, "output_dir": folder}
        if not step.steps:
            path = folder / PRETRAINED_MODEL_DIR
            argv = lerobot_wm("init", settings, *flags)
            return Checkpoint(Stage(name, step.kind, argv, folder, path, needs), path)
        settings |= {
            "steps": step.steps,
            "save_freq": 1000,
            "dataset.episodes": f"[{','.join(map(str, self.episodes(step)))}]",
            "policy.push_to_hub": "false",
            "policy.device": "cpu",
        }
        final = get_step_checkpoint_dir(folder, step.steps, step.steps)
        last = folder / "checkpoints" / "last" / PRETRAINED_MODEL_DIR / TRAIN_CONFIG_NAME
        stage = Stage(
            name=name,
            kind=step.kind,
            argv=lerobot_wm("train", settings, *flags),
            folder=folder,
            artefact=final / TRAINING_STATE_DIR / OPTIMIZER_PARAM_GROUPS,
            needs=needs,
            checkpoint=last,
            can_resume=can_resume,
            resume_argv=lerobot_wm("train", {"config_path": last, "resume": "true"}),
        )
        return Checkpoint(stage, final / PRETRAINED_MODEL_DIR)

    def evaluation(self, arm: str) -> Stage:
        """Rollouts on positions without a demonstration, as many of each test task."""
        policy = self.checkpoint(ARMS[arm])
        name = f"{policy.made_by.name}_eval_{self.variation_set}_{self.n_rollouts}"
        folder = self.output_dir / name
        flags = {
            "policy.path": policy.path,
            "env.type": ENV_TYPE,
            "env.task": "ml45_test",
            "env.variation_set": self.variation_set,
            "env.camera_name": MT50.camera_name,
            "env.episode_length": MT50.episode_length,
            "env.environment_state": str(arm == FULL_STATE).lower(),
            "eval.n_episodes": self.n_rollouts,
            "videos_per_task": 2,
            "seed": 0,
            "output_dir": folder,
            "arm": f"{arm}-{self.tasks_seen(ARMS[arm])}-{self.n_demonstrations}",
            "preset": "few_shot",
        }
        argv = lerobot_wm("eval", flags)
        return Stage(
            name, "evaluate", argv, folder, folder / RECORDS_NAME, (policy.made_by,), takes_workers=True
        )


def main() -> None:
    """Run the stages of the arms that were asked for."""
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("--arms", default=",".join(ARMS))
    parser.add_argument("--demonstrations", default="1,5,10,25", help="of each task")
    parser.add_argument("--seeds", default="0,1,2")
    parser.add_argument("--tasks", default="45", help="that the world model is pretrained on: 5,15,45")
    parser.add_argument("--variation_set", type=int, default=44, help="of rollouts: 43 to tune, 44 to report")
    parser.add_argument("--rollouts", type=int, default=50, help="of each test task")
    parser.add_argument("--processes", type=int, default=usable_cores())
    parser.add_argument("--output_dir", type=Path, default=Path("outputs/few_shot"))
    parser.add_argument("--list", action="store_true", help="only print the stages, and their minutes")
    arguments = parser.parse_args()
    output_dir: Path = arguments.output_dir
    data = Plan(MT50, output_dir.parent / MT50.name, MT50.variation_set).demonstrations()
    numbers = {
        name: [int(each) for each in vars(arguments)[name].split(",")]
        for name in ("tasks", "demonstrations", "seeds")
    }
    stages = [
        Transfer(
            data, output_dir, tasks, count, seed, arguments.variation_set, arguments.rollouts
        ).evaluation(arm)
        for tasks in numbers["tasks"]
        for count in numbers["demonstrations"]
        for seed in numbers["seeds"]
        for arm in arguments.arms.split(",")
    ]
    times, console = Times(output_dir / "times.json", MINUTES), Console()
    if arguments.list:
        for name, stage in in_order(stages).items():
            state = "finished" if stage.is_finished else minutes_text(times.minutes(stage.kind))
            console.print(f"{name}: {state}", highlight=False)
        return
    with sole_writer(output_dir) as lock:
        runner = Runner(
            unfinished(stages),
            arguments.processes,
            usable_cores(),
            times,
            console,
            on_finish=lambda stage: None,
        )
        failed = runner.run(lock)
    if failed:
        sys.exit(f"Failed: {', '.join(stage.name for stage in failed)}; see their logs.")


if __name__ == "__main__":
    main()
