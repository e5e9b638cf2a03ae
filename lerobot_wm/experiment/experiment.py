"""Some arms and seeds of a preset: what is done, what is left, and doing it."""

import shutil
import subprocess
from pathlib import Path
from typing import IO

from rich.console import Console
from rich.table import Column, Table

from lerobot_wm.constants import RECORDS_NAME, REPORTED_VARIATION_SET
from lerobot_wm.experiment.arms import Arm
from lerobot_wm.experiment.ledger import Ledger
from lerobot_wm.experiment.plan import Plan
from lerobot_wm.experiment.runner import Progress, Runner, Times, environment, minutes_left, minutes_text
from lerobot_wm.experiment.stage import Stage, in_order, lerobot_wm, unfinished
from lerobot_wm.system import usable_cores


def report_command(plan: Plan, runs: list[tuple[Arm, int]], records: Path, folder: Path) -> tuple[str, ...]:
    """`lerobot-wm report` over all records, with the videos and curves of each arm's first seed.

    Args:
        plan: The experiment.
        runs: Its arms and seeds.
        records: The records file.
        folder: Where the report goes.
    """
    first = {arm.name: (arm, seed) for arm, seed in reversed(runs)}.values()
    trained = [(arm, seed) for arm, seed in first if arm.config is not None]  # the expert leaves no videos
    evaluations = [stage for run in trained for stage in plan.evaluations(*run)]
    trainings = [stage for arm, seed in trained if not arm.individual for stage in plan.policies(arm, seed)]
    seed = runs[0][1]
    world_model, quality, dataset = plan.world_model(seed), plan.quality(seed), plan.demonstrations.sparse()
    flags: dict[str, object] = {
        "records": records,
        "output_dir": folder,
        "title": f"World-model policies and controls, preset {plan.preset.name}",
    }
    for flag, stages in (("videos", evaluations), ("train_logs", [world_model.made_by, *trainings])):
        folders = dict.fromkeys(str(stage.folder) for stage in stages if stage.finished)
        if folders:
            flags[flag] = ",".join(folders)
    # Once all is trained the demonstrations may have been removed: the world model is shown on them.
    if world_model.made_by.finished and dataset.made_by.finished:
        flags |= {"world_model_path": world_model.path, **dataset.flags()}
    if quality.finished:
        flags["quality"] = quality.artefact
    return lerobot_wm("report", flags)


class Experiment:
    """Some arms and seeds of a preset, and how far they are.

    Args:
        plan: Builds the stages.
        runs: The arms and seeds.
        results_dir: Holds the committed records, compressed.
        processes: Stages side by side at most.
        quality: Whether the world model is judged, too.
    """

    def __init__(
        self, plan: Plan, runs: list[tuple[Arm, int]], results_dir: Path, processes: int, quality: bool
    ) -> None:
        self.plan = plan
        self.runs = runs
        self.processes = processes
        suffix = "" if plan.variation_set == REPORTED_VARIATION_SET else f"_set{plan.variation_set}"
        records = f"records{suffix}.jsonl"
        self._committed = results_dir / f"{records}.gz"
        self.ledger = Ledger(plan.output_dir / records, self._committed, plan.preset)
        self.report_dir = plan.output_dir / f"report{suffix}"
        self.times = Times(plan.output_dir / "times.json", plan.preset.minutes)
        self._quality = [plan.quality(runs[0][1])] if quality else []

    def _open_runs(self) -> list[tuple[Arm, int]]:
        """The arms and seeds whose records are not complete."""
        return [(arm, seed) for arm, seed in self.runs if (arm.name, seed) not in self.ledger]

    def targets(self) -> list[Stage]:
        """The last stages of what is not recorded yet."""
        return [
            *(stage for run in self._open_runs() for stage in self.plan.evaluations(*run)),
            *self._quality,
        ]

    def settle(self) -> None:
        """Take the rollouts of arms and seeds that have become complete into the records."""
        for arm, seed in self._open_runs():
            stages = self.plan.evaluations(arm, seed)
            if all(stage.finished for stage in stages):
                self.ledger.add(arm.name, seed, [stage.folder / RECORDS_NAME for stage in stages])

    def show(self, console: Console) -> None:
        """Print every stage and its state."""
        todo = unfinished(self.targets())
        table = Table(Column("stage", overflow="fold"), "state", "minutes", box=None)
        for arm, seed in self.runs:
            if (arm.name, seed) in self.ledger:
                table.add_row(f"{arm.name}, seed {seed}", "records complete", "")
        for name, stage in in_order(self.targets()).items():
            if name in todo:
                state = "goes on from its checkpoint" if stage.resumes else "to run"
                table.add_row(name, state, f"{self.times.minutes(stage.kind):.1f}")
            else:
                table.add_row(name, "finished" if stage.finished else "not needed", "")
        console.print(table)
        minutes = {name: self.times.minutes(stage.kind) for name, stage in todo.items()}
        left = minutes_text(minutes_left(todo, minutes, self.processes))
        console.print(f"Stages to run: {len(todo)}, about {left} with {self.processes} side by side")

    def tell_committed(self, console: Console) -> None:
        """Say which arms and seeds are not run: with changed settings their records would be taken for new ones."""
        taken = [
            f"{arm.name} {seed}" for arm, seed in self.runs if self.ledger.is_committed((arm.name, seed))
        ]
        if taken:
            console.print(
                f"Not run, but taken from {self._committed}: {', '.join(taken)} (arm and seed). "
                "--results_dir=outputs/none runs them, too.",
                highlight=False,
            )

    def run(self, lock: IO, console: Console) -> list[Stage]:
        """Run what is left; returns the stages that failed.

        Args:
            lock: A file that every stage holds open.
            console: Where progress is shown.
        """
        self.settle()
        todo = unfinished(self.targets())
        with Progress(console, self.times, self.processes, len(todo)) as progress:
            return Runner(
                todo,
                self.processes,
                usable_cores(),
                self.times,
                progress,
                on_finish=lambda stage: self.settle(),
            ).run(lock)

    def report(self) -> bool:
        """Write the records and the report, where anything is finished; returns whether that went well."""
        if self.ledger.empty:
            return True
        self.ledger.write()
        shutil.rmtree(self.report_dir, ignore_errors=True)  # cheap, so it always shows the records there are
        command = report_command(self.plan, self.runs, self.ledger.path, self.report_dir)
        return subprocess.run(command, env=environment(usable_cores())).returncode == 0
