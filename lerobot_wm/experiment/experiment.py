"""`scripts/reproduce_table1.py`: some arms and seeds of a preset, from demonstrations to the table."""

import argparse
import shutil
import signal
import subprocess
import sys
from pathlib import Path
from typing import IO

from rich.console import Console
from rich.table import Column, Table

from lerobot_wm.constants import RECORDS_NAME, VARIATION_SETS
from lerobot_wm.experiment.plan import Plan
from lerobot_wm.experiment.preset import CONFIGS, Preset, load_preset, select_runs, write_settings
from lerobot_wm.experiment.runner import Runner, Times, environment, minutes_left, minutes_text
from lerobot_wm.experiment.stage import Stage, in_order, lerobot_wm, unfinished
from lerobot_wm.files import sole_writer, write_whole
from lerobot_wm.records import Record, read_records, record_line
from lerobot_wm.report.arms import ARMS, Arm
from lerobot_wm.system import usable_cores

type Runs = dict[tuple[str, int | None], list[Record]]  # by (arm, seed)


class Ledger:
    """The records of an experiment by (arm, seed): committed ones, and those of its own rollouts.

    An arm and seed is finished once all its rollouts are recorded, one on every variation of every task. Own records
    are stored separately, so that another run can do without the committed ones. Records of other presets do not count.

    Args:
        path: File for all records; the own ones are beside it in `own_<name>`.
        committed: Records that count without the output folders of their runs.
        preset: Says which rollouts an arm and seed has.
    """

    def __init__(self, path: Path, committed: Path, preset: Preset) -> None:
        self.path = path
        self._own_path = path.with_name(f"own_{path.name}")
        self._preset = preset
        self.committed = self._finished_runs([committed])
        self._own = self._finished_runs([self._own_path])

    @property
    def runs(self) -> Runs:
        """All finished arms and seeds; committed records take precedence."""
        return self._own | self.committed

    def add(self, files: list[Path]) -> None:
        """Add the rollouts of an arm and seed.

        Raises:
            ValueError: The files do not hold all of them.
        """
        finished = self._finished_runs(files)
        if not finished:
            raise ValueError(
                f"{', '.join(map(str, files))}: these are not all rollouts of an arm in preset {self._preset.name}. "
                "Remove their folders to roll out again."
            )
        self._own |= finished
        _write(self._own_path, self._own)

    def write(self) -> None:
        """Write all records to one file."""
        _write(self.path, self.runs)

    def _finished_runs(self, files: list[Path]) -> Runs:
        found = [file for file in files if file.is_file()]
        runs: Runs = {}
        for record in read_records(found) if found else []:
            if record["preset"] == self._preset.name:
                runs.setdefault((record["arm"], record["seed"]), []).append(record)
        rollouts = {(task, k) for task in self._preset.task_names for k in self._preset.rollout_variations}
        return {
            run: records
            for run, records in runs.items()
            if {(record["task"], record["variation"]) for record in records} == rollouts
        }


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
    world_model, quality, dataset = plan.world_model(seed), plan.quality(seed), plan.demonstrations()
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
        records = f"records{plan.suffix}.jsonl"
        self._committed = results_dir / f"{records}.gz"
        self.ledger = Ledger(plan.output_dir / records, self._committed, plan.preset)
        self.report_dir = plan.output_dir / f"report{plan.suffix}"
        self.times = Times(plan.output_dir / "times.json", plan.preset.minutes)
        self._quality = [plan.quality(runs[0][1])] if quality else []

    def _open_runs(self) -> list[tuple[Arm, int]]:
        """The arms and seeds whose records are incomplete."""
        return [(arm, seed) for arm, seed in self.runs if (arm.name, seed) not in self.ledger.runs]

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
                self.ledger.add([stage.folder / RECORDS_NAME for stage in stages])

    def show(self, console: Console) -> None:
        """Print every stage and its state; writes nothing."""
        todo = unfinished(self._targets())
        table = Table(Column("stage", overflow="fold"), "state", "minutes", box=None)
        for arm, seed in self.runs:
            if (arm.name, seed) in self.ledger.runs:
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
        taken = [f"{arm.name} {seed}" for arm, seed in self.runs if (arm.name, seed) in self.ledger.committed]
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
        runner = Runner(
            unfinished(self._targets()),
            self.processes,
            usable_cores(),
            self.times,
            console,
            on_finish=lambda stage: self._record_finished(),
        )
        return runner.run(lock)

    def report(self) -> bool:
        """Write the records and the report if anything is finished, and return whether that succeeded."""
        if not self.ledger.runs:
            return True
        self.ledger.write()
        # It is cheap to write, so it always shows the latest records.
        shutil.rmtree(self.report_dir, ignore_errors=True)
        command = report_command(self.plan, self.runs, self.ledger.path, self.report_dir)
        return subprocess.run(command, env=environment(usable_cores())).returncode == 0


# Lines of a failed stage's log that are shown.
LOG_TAIL = 15


def show_failures(failed: list[Stage], console: Console) -> None:
    """Print the name of each failed stage and the end of its log."""
    for stage in failed:
        lines = stage.log.read_text(errors="replace").splitlines()[-LOG_TAIL:]
        console.print(f"\n[red]{stage.name} failed.[/] The end of {stage.log}:", highlight=False)
        console.print("\n".join(lines), markup=False, highlight=False, soft_wrap=True)


def make_parser() -> argparse.ArgumentParser:
    """Define the command line."""
    parser = argparse.ArgumentParser(
        description="Table 1 of the paper with controls: any arms and seeds, from demonstrations to the report. "
        "You can stop it and run it again: finished stages are not repeated, training resumes from its last "
        "checkpoint, and an arm and seed whose records are complete does not run.",
        epilog=f"Arms: {', '.join(ARMS)}.",
    )
    presets = sorted(file.stem for file in CONFIGS.glob("*.json"))
    parser.add_argument("--preset", required=True, choices=presets, help="NAME of configs/NAME.json")
    parser.add_argument("--arms", default="", help="names separated by commas; the preset's by default")
    parser.add_argument(
        "--seeds", default="", help="training seeds separated by commas; the preset's by default"
    )
    parser.add_argument("--output_dir", type=Path, help="outputs/PRESET by default")
    parser.add_argument("--results_dir", type=Path, help="committed records; results/PRESET by default")
    parser.add_argument(
        "--processes",
        type=int,
        default=usable_cores(),
        help="how many stages run side by side (%(default)s)",
    )
    parser.add_argument(
        "--variation_set",
        type=int,
        choices=VARIATION_SETS,
        help="variations to roll out on, by default the preset's: 42 to report, 43 to tune, 44 to confirm; others are "
        "recorded in separate files",
    )
    parser.add_argument(
        "--quality", action="store_true", help="also measure the world model's quality (lerobot-wm quality)"
    )
    parser.add_argument("--list", action="store_true", help="only print the stages and their state")
    return parser


def main() -> None:
    """Entry point of `scripts/reproduce_table1.py`."""
    parser = make_parser()
    args = parser.parse_args()
    if args.processes < 1:
        parser.error(f"--processes={args.processes}: expected at least 1")
    console = Console()
    try:
        preset = load_preset(args.preset)
        runs = select_runs(preset, _names(args.arms), [int(seed) for seed in _names(args.seeds)])
        output_dir = args.output_dir or Path("outputs") / preset.name
        results_dir = args.results_dir or Path("results") / preset.name
        plan = Plan(preset, output_dir, args.variation_set or preset.variation_set)
        if args.list:
            Experiment(plan, runs, results_dir, args.processes, args.quality).show(console)
            return
        # Stop as on Ctrl-C.
        signal.signal(signal.SIGTERM, signal.default_int_handler)
        with sole_writer(output_dir) as lock:
            write_settings(preset, output_dir)
            experiment = Experiment(plan, runs, results_dir, args.processes, args.quality)
            experiment.name_committed(console)
            failed = experiment.run(lock, console)
            reported = experiment.report()
    except (ValueError, OSError) as error:
        sys.exit(f"reproduce_table1: {error}")
    except KeyboardInterrupt:
        sys.exit("\nStopped. Run the same command again to resume.")
    show_failures(failed, console)
    if failed:
        sys.exit(f"{len(failed)} stages failed. Run the same command to try them again.")
    if not reported:
        sys.exit("The report failed for the reason above. The records are complete.")


def _names(comma_separated: str) -> list[str]:
    return [name.strip() for name in comma_separated.split(",") if name.strip()]
