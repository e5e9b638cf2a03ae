"""Some arms and seeds of a preset: what is finished, what is left, and running it."""

import shutil
import subprocess
from pathlib import Path
from typing import IO

from rich.console import Console
from rich.table import Column, Table

from lerobot_wm.constants import RECORDS_NAME, REPORTED_VARIATION_SET
from lerobot_wm.experiment.plan import Plan
from lerobot_wm.experiment.preset import Preset
from lerobot_wm.experiment.runner import Progress, Runner, Times, environment, minutes_left, minutes_text
from lerobot_wm.experiment.stage import Stage, in_order, lerobot_wm, unfinished
from lerobot_wm.files import write_whole
from lerobot_wm.records import Record, read_records, record_line
from lerobot_wm.report.arms import Arm
from lerobot_wm.system import usable_cores

type Runs = dict[tuple[str, int | None], list[Record]]  # by (arm, seed)


class Ledger:
    """The records of an experiment by (arm, seed): committed ones, and those of its own rollouts.

    It contains an arm and seed once all its rollouts are recorded, one on every variation of every task. Committed
    records take precedence. Own ones are stored separately, so that another run can do without the committed ones.

    Args:
        path: File for all records; the own ones are beside it in `own_<name>`.
        committed: Records that count without the output folders of their runs.
        preset: Says which rollouts an arm and seed has.

    Raises:
        ValueError: A file holds something other than records, or records of another preset.
    """

    def __init__(self, path: Path, committed: Path, preset: Preset) -> None:
        self.path = path
        self._own_path = path.with_name(f"own_{path.name}")
        self._preset = preset.name
        self._rollouts = {(task, k) for task in preset.task_names for k in preset.variations}
        self._committed = self._complete_runs(committed)
        self._own = self._complete_runs(self._own_path)

    def __contains__(self, run: tuple[str, int]) -> bool:
        """Whether an arm and seed is finished."""
        return run in self._committed or run in self._own

    def is_committed(self, run: tuple[str, int]) -> bool:
        """Whether the records of an arm and seed are committed."""
        return run in self._committed

    @property
    def empty(self) -> bool:
        """Whether nothing is finished."""
        return not self._committed and not self._own

    def add(self, arm: str, seed: int, files: list[Path]) -> None:
        """Add the rollouts of a finished arm and seed, unless they are recorded already.

        Raises:
            ValueError: The files hold other rollouts, or rollouts of another preset.
        """
        if (arm, seed) in self:
            return
        records = self._read(files)
        if set(_by_run(records)) != {(arm, seed)} or not self._is_complete(records):
            found = sorted({(record["arm"], record["seed"]) for record in records}, key=str)
            raise ValueError(
                f"{', '.join(map(str, files))}: {len(records)} rollouts of (arm, seed) {found}; expected the "
                f"{len(self._rollouts)} of ('{arm}', {seed}). Remove their folders to roll out again."
            )
        self._own[arm, seed] = records
        _write(self._own_path, self._own)

    def write(self) -> None:
        """Write all records to one file."""
        _write(self.path, self._own | self._committed)

    def _complete_runs(self, file: Path) -> Runs:
        if not file.is_file() or not file.stat().st_size:
            return {}
        return {run: rows for run, rows in _by_run(self._read([file])).items() if self._is_complete(rows)}

    def _read(self, files: list[Path]) -> list[Record]:
        records = read_records(files)
        others = {record["preset"] for record in records} - {self._preset}
        if others:
            raise ValueError(
                f"{', '.join(map(str, files))}: rollouts of the preset {', '.join(sorted(map(str, others)))}; "
                f"expected '{self._preset}'. Use another --output_dir or --results_dir."
            )
        return records

    def _is_complete(self, records: list[Record]) -> bool:
        return {(record["task"], record["variation"]) for record in records} == self._rollouts


def _by_run(records: list[Record]) -> Runs:
    """Records by (arm, seed), in order."""
    runs: Runs = {}
    for record in records:
        runs.setdefault((record["arm"], record["seed"]), []).append(record)
    return runs


def _write(path: Path, runs: Runs) -> None:
    write_whole(path, "".join(record_line(record) for rows in runs.values() for record in rows))


def report_command(plan: Plan, runs: list[tuple[Arm, int]], records: Path, folder: Path) -> tuple[str, ...]:
    """Compose `lerobot-wm report` over all records, with the videos and curves of each arm's first seed.

    Args:
        plan: The experiment.
        runs: Its arms and seeds.
        records: The records file.
        folder: Where the report is written.
    """
    first = {arm.name: (arm, seed) for arm, seed in reversed(runs)}.values()
    # The expert has no videos.
    trained = [(arm, seed) for arm, seed in first if arm.training is not None]
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
        folders = dict.fromkeys(str(stage.folder) for stage in stages if stage.is_finished)
        if folders:
            flags[flag] = ",".join(folders)
    # The world model is shown on the demonstrations. They may be removed once everything is trained.
    if world_model.made_by.is_finished and dataset.made_by.is_finished:
        flags |= {"world_model_path": world_model.path, **dataset.flags()}
    if quality.is_finished:
        flags["quality"] = quality.artefact
    return lerobot_wm("report", flags)


class Experiment:
    """Some arms and seeds of a preset, and their progress.

    Args:
        plan: Builds the stages.
        runs: The arms and seeds.
        results_dir: Committed records, compressed.
        processes: How many stages run side by side at most.
        quality: Whether the world model's quality is measured too.
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
        """The arms and seeds whose records are incomplete."""
        return [(arm, seed) for arm, seed in self.runs if (arm.name, seed) not in self.ledger]

    def _targets(self) -> list[Stage]:
        """The last stages of all that is not recorded yet."""
        return [
            *(stage for run in self._open_runs() for stage in self.plan.evaluations(*run)),
            *self._quality,
        ]

    def _record_finished(self) -> None:
        """Add the rollouts of newly finished arms and seeds to the records."""
        for arm, seed in self._open_runs():
            stages = self.plan.evaluations(arm, seed)
            if all(stage.is_finished for stage in stages):
                self.ledger.add(arm.name, seed, [stage.folder / RECORDS_NAME for stage in stages])

    def show(self, console: Console) -> None:
        """Print every stage and its state; writes nothing."""
        todo = unfinished(self._targets())
        table = Table(Column("stage", overflow="fold"), "state", "minutes", box=None)
        for arm, seed in self.runs:
            if (arm.name, seed) in self.ledger:
                table.add_row(f"{arm.name}, seed {seed}", "records complete", "")
        for name, stage in in_order(self._targets()).items():
            if name in todo:
                state = "to resume" if stage.is_resumable else "to run"
                table.add_row(name, state, f"{self.times.minutes(stage.kind):.1f}")
            else:
                table.add_row(name, "finished" if stage.is_finished else "not needed", "")
        console.print(table)
        minutes = {name: self.times.minutes(stage.kind) for name, stage in todo.items()}
        left = minutes_text(minutes_left(todo, minutes, self.processes))
        console.print(f"Stages to run: {len(todo)}, about {left} with {self.processes} side by side")

    def name_committed(self, console: Console) -> None:
        """Print which arms and seeds do not run because their records are committed.

        Otherwise a user who has changed settings would take these records for new ones.
        """
        taken = [
            f"{arm.name} {seed}" for arm, seed in self.runs if self.ledger.is_committed((arm.name, seed))
        ]
        if taken:
            console.print(
                f"Records taken from {self._committed}, not run: {', '.join(taken)} (arm and seed). "
                "Run them too with --results_dir=outputs/none.",
                highlight=False,
            )

    def run(self, lock: IO, console: Console) -> list[Stage]:
        """Run the unfinished stages and return those that failed.

        Args:
            lock: A file that every stage holds open.
            console: Where progress is shown.
        """
        self._record_finished()
        todo = unfinished(self._targets())
        with Progress(console, self.times, self.processes, len(todo)) as progress:
            return Runner(
                todo,
                self.processes,
                usable_cores(),
                self.times,
                progress,
                on_finish=lambda stage: self._record_finished(),
            ).run(lock)

    def report(self) -> bool:
        """Write the records and the report if anything is finished, and return whether that succeeded."""
        if self.ledger.empty:
            return True
        self.ledger.write()
        # It is cheap to write, so it always shows the latest records.
        shutil.rmtree(self.report_dir, ignore_errors=True)
        command = report_command(self.plan, self.runs, self.ledger.path, self.report_dir)
        return subprocess.run(command, env=environment(usable_cores())).returncode == 0
