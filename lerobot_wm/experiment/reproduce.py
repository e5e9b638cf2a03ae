"""`scripts/reproduce_table1.py`: any arms and seeds of the experiment, from demonstrations to the table."""

import argparse
import signal
import sys
from pathlib import Path

from rich.console import Console

from lerobot_wm.constants import REPORTED_VARIATION_SET, VARIATION_SETS
from lerobot_wm.experiment.experiment import Experiment
from lerobot_wm.experiment.plan import Plan
from lerobot_wm.experiment.preset import load_preset, select_runs, write_settings
from lerobot_wm.experiment.runner import hold_lock
from lerobot_wm.experiment.stage import Stage
from lerobot_wm.report.arms import ARMS
from lerobot_wm.system import usable_cores

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
    parser.add_argument("--preset", required=True, help="NAME of configs/NAME.json")
    parser.add_argument("--arms", default="", help="names separated by commas; the preset's by default")
    parser.add_argument(
        "--seeds", default="", help="training seeds separated by commas; the preset's by default"
    )
    parser.add_argument("--output_dir", type=Path, help="outputs/PRESET by default")
    parser.add_argument("--results_dir", type=Path, help="committed records; results/PRESET by default")
    parser.add_argument(
        "--processes", type=int, default=usable_cores(), help="how many stages run side by side (%(default)s)"
    )
    parser.add_argument(
        "--variation_set",
        type=int,
        choices=VARIATION_SETS,
        default=REPORTED_VARIATION_SET,
        help="variations to roll out on: 42 to report, 43 to tune, 44 to confirm; recorded in separate files "
        "(%(default)s)",
    )
    parser.add_argument(
        "--quality", action="store_true", help="also measure the world model's quality (lerobot-wm quality)"
    )
    parser.add_argument("--list", action="store_true", help="only print the stages and their state")
    return parser


def main() -> None:
    """Entry point of `scripts/reproduce_table1.py`."""
    args = make_parser().parse_args()
    console = Console()
    try:
        preset = load_preset(args.preset)
        runs = select_runs(preset, _names(args.arms), [int(seed) for seed in _names(args.seeds)])
        output_dir = args.output_dir or Path("outputs") / preset.name
        results_dir = args.results_dir or Path("results") / preset.name
        plan = Plan(preset, output_dir, args.variation_set)
        if args.processes < 1:
            raise ValueError(f"--processes={args.processes}: expected at least 1.")
        if args.list:
            Experiment(plan, runs, results_dir, args.processes, args.quality).show(console)
            return
        # Stop as on Ctrl-C.
        signal.signal(signal.SIGTERM, signal.default_int_handler)
        with hold_lock(output_dir) as lock:
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
