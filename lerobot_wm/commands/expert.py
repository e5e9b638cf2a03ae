"""`lerobot-wm expert`: roll out the scripted expert without noise, once on each variation, as a reference."""

from dataclasses import dataclass
from functools import partial
from pathlib import Path

import draccus
import numpy as np
from rich.console import Console
from tqdm import tqdm

from lerobot_wm.collect.episode import demonstrate
from lerobot_wm.constants import MAX_EPISODE_STEPS, NUM_VARIATIONS, RECORDS_NAME, REPORTED_VARIATION_SET
from lerobot_wm.envs.simulation import Simulation
from lerobot_wm.envs.tasks import resolve_tasks
from lerobot_wm.envs.variations import check_variation_set, is_seen, parse_variations
from lerobot_wm.files import write_whole
from lerobot_wm.records import Record, new_records, record_line
from lerobot_wm.system import quiet, silence
from lerobot_wm.tables import table_by_split, terminal_tables
from lerobot_wm.workers import map_in_workers

ARM = "expert"


@dataclass
class ExpertConfig:
    """Flags of `lerobot-wm expert`."""

    # Folder of records.jsonl.
    output_dir: Path
    # A task, a set (mt6, mt10, mt50, ml45, ml45_test) or a comma-separated list.
    tasks: str = "mt6"
    # Set of variations: 42 for reported results, 43 for choosing settings and for probes, 44 for a final choice.
    variation_set: int = REPORTED_VARIATION_SET
    # Variations to roll out on: ranges and numbers from 0 to 49, such as 0-9 or 0-4,7.
    variations: str = f"0-{NUM_VARIATIONS - 1}"
    # Steps after which a rollout is a failure, at most 500; like --env.episode_length of `lerobot-wm eval`.
    episode_length: int = MAX_EPISODE_STEPS
    # Name of the settings in records.
    preset: str = "custom"
    # Processes; each takes whole tasks.
    num_workers: int = 2


def _roll_out(cfg: ExpertConfig, variations: tuple[int, ...], task: str) -> list[Record]:
    simulation = Simulation(task, cfg.variation_set)
    return [_record(cfg, simulation, variation) for variation in variations]


def _record(cfg: ExpertConfig, simulation: Simulation, variation: int) -> Record:
    """One rollout, which ends with success or after `episode_length` steps, as in the environment."""
    # Without effect: the noise is zero.
    rng = np.random.default_rng(0)
    demonstration = demonstrate(
        simulation, variation, noise=0.0, steps_after_success=0, rng=rng, max_steps=cfg.episode_length
    )
    success = demonstration is not None
    return {
        "arm": ARM,
        "policy_type": "scripted",
        "preset": cfg.preset,
        "seed": 0,
        "task": simulation.task,
        "variation": variation,
        "seen": is_seen(variation, cfg.variation_set),
        "success": success,
        "steps": cfg.episode_length if demonstration is None else len(demonstration.actions),
        "return": float(success),
        "variation_set": cfg.variation_set,
    }


def main() -> None:
    """Entry point of `lerobot-wm expert`."""
    cfg = draccus.parse(ExpertConfig)
    tasks, variations = resolve_tasks(cfg.tasks), parse_variations(cfg.variations)
    check_variation_set(cfg.variation_set)
    file = cfg.output_dir / RECORDS_NAME
    with new_records(file), quiet():
        rollouts = map_in_workers(partial(_roll_out, cfg, variations), tasks, cfg.num_workers, silence)
        progress = tqdm(rollouts, total=len(tasks), desc="Rolling out", unit="task")
        records = [record for task_records in progress for record in task_records]
        write_whole(file, "".join(map(record_line, records)))
    Console(width=100).print(*terminal_tables(table_by_split("Success of the scripted expert", records)))
    print(f"Records: {file}")
