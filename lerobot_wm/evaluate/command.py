"""`lerobot-wm eval`: `lerobot-eval` with its flags, and a record of each rollout.

Unlike there, each seed runs exactly once for any batch size, tasks can be spread over processes, and a records file has
one line per rollout.
"""

import json
import logging
import os
import time
from collections.abc import Callable, Iterator
from copy import deepcopy

import torch
from lerobot.configs import parser
from lerobot.policies import make_policy
from lerobot.utils.utils import init_logging
from rich.console import Console
from tqdm import tqdm

from lerobot_wm.constants import EVAL_INFO_NAME
from lerobot_wm.evaluate.rollouts import EvaluateConfig, TaskRunner, task_names
from lerobot_wm.evaluate.wandb_log import log_evaluation, wandb_run
from lerobot_wm.files import appears_whole
from lerobot_wm.policies.common.checkpoint import open_checkpoint
from lerobot_wm.policies.common.config import PolicyConfig
from lerobot_wm.records import (
    Record,
    group_by_task,
    is_in_split,
    new_records,
    present_splits,
    provenance,
    record_line,
    summarize_success,
)
from lerobot_wm.system import hide_harmless_messages, usable_cores
from lerobot_wm.tables import table_by_split, terminal_tables
from lerobot_wm.workers import map_in_workers

# In a worker process: rolls out one task, with the policy that `_start_worker` loaded.
_worker_run: Callable[[str], list[Record]]


def _start_worker(cfg: EvaluateConfig, threads: int) -> None:
    global _worker_run
    hide_harmless_messages()
    torch.set_num_threads(threads)
    _worker_run = TaskRunner(cfg).run


def _run_in_worker(task: str) -> list[Record]:
    return _worker_run(task)


def _rollouts(cfg: EvaluateConfig, tasks: list[str]) -> Iterator[list[Record]]:
    """Records task by task, in the order of `tasks`; with one process, the policy is loaded when this returns."""
    workers = min(cfg.num_workers, len(tasks))
    if workers <= 1:
        return map(TaskRunner(cfg).run, tasks)
    threads = max(1, usable_cores() // workers)
    # LeRobot's progress bars of several processes would overwrite each other and the parent's. tqdm reads this variable
    # when a worker imports it, and shows no bar before so many seconds.
    os.environ["TQDM_DELAY"] = "1000000000"
    return map_in_workers(_run_in_worker, tasks, workers, _start_worker, cfg, threads)


def evaluate(cfg: EvaluateConfig) -> list[Record]:
    """Roll out every seed of every task; write records, videos and eval_info.json under `cfg.output_dir`.

    The records file appears when the last rollout is done; until then its lines are in `<name>.part`.

    Raises:
        ValueError: See `EvaluateConfig.validate`.
        FileExistsError, BlockingIOError: See `new_records`.
        ValueError, FileNotFoundError: The checkpoint is damaged or incomplete, or its processors name other code.
    """
    cfg.validate()
    path, revision = cfg.policy.pretrained_path, cfg.policy.pretrained_revision
    with new_records(cfg.records_file):
        open_checkpoint(path, revision)
        if isinstance(cfg.policy, PolicyConfig):
            # Ours are small: one that does not fit is found before environments are built.
            make_policy(deepcopy(cfg.policy), env_cfg=cfg.env, rename_map=cfg.rename_map)
        tasks = task_names(cfg)
        with wandb_run(cfg.wandb, path, cfg.output_dir, revision) as run:
            records = _write_records(cfg, tasks)
            if run is not None:
                log_evaluation(run, cfg.arm_name, records)
    return records


def _write_records(cfg: EvaluateConfig, tasks: list[str]) -> list[Record]:
    started = time.perf_counter()
    cfg.output_dir.mkdir(parents=True, exist_ok=True)
    records: list[Record] = []
    # Before the bar, because LeRobot prints while it loads the policy.
    rollouts = _rollouts(cfg, tasks)
    total = len(tasks) * len(cfg.seeds)
    # Without a terminal, LeRobot's bar below this one would print cursor movements.
    progress = tqdm(total=total, desc="Rolling out", unit="rollout", disable=None)
    # The records appear last, when everything else is written.
    with appears_whole(cfg.records_file) as temporary:
        with temporary.open("w") as file, progress:
            for task_records in rollouts:
                records += task_records
                file.writelines(map(record_line, task_records))
                file.flush()
                progress.update(len(task_records))
                if progress.disable:
                    logging.info("%d of %d rollouts", len(records), total)
        _write_info(cfg, records, seconds=time.perf_counter() - started)
    return records


def _write_info(cfg: EvaluateConfig, records: list[Record], seconds: float) -> None:
    """Write eval_info.json: success rates with intervals per task, split and overall, and their provenance."""
    by_split = {
        split: summarize_success(r for r in records if is_in_split(r, split))
        for split in present_splits(records)
    }
    overall = by_split.pop("all")
    info = {
        "arm": cfg.arm_name,
        "policy_path": str(cfg.policy.pretrained_path),
        "per_task": {task: summarize_success(rows) for task, rows in group_by_task(records).items()},
        **by_split,
        "overall": overall,
        "eval_s": seconds,
        "provenance": provenance(),
    }
    (cfg.output_dir / EVAL_INFO_NAME).write_text(json.dumps(info, indent=2) + "\n")


@parser.wrap()
def _evaluate_from_command_line(cfg: EvaluateConfig) -> None:
    records = evaluate(cfg)
    Console(width=100).print(*terminal_tables(table_by_split(f"Success of {cfg.arm_name}", records)))
    logging.info("Records: %s", cfg.records_file)


def main() -> None:
    """Entry point of `lerobot-wm eval`."""
    init_logging()
    path = parser.get_path_arg("policy")
    if path:  # before LeRobot's parser reads it, which would show a traceback
        open_checkpoint(path, parser.parse_arg("policy.pretrained_revision"))
    _evaluate_from_command_line()  # type: ignore[call-arg]
