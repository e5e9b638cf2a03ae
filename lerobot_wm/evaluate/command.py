"""`lerobot-wm eval`: lerobot-eval with its flags, one record per rollout.

What is added to LeRobot's own rollouts: each seed runs exactly once whatever the batch size, tasks can be
spread over processes, and every rollout leaves a line in a records file.
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
from lerobot_wm.evaluate.config import EvaluateConfig
from lerobot_wm.evaluate.rollouts import TaskRunner, task_names
from lerobot_wm.evaluate.wandb_log import log_evaluation, wandb_run
from lerobot_wm.policies.common.checkpoint import open_checkpoint
from lerobot_wm.policies.common.config import PolicyConfig
from lerobot_wm.quiet import drop_remarks
from lerobot_wm.records import (
    Record,
    is_in_split,
    new_records,
    provenance,
    record_line,
    summarize_success,
)
from lerobot_wm.system import usable_cores
from lerobot_wm.tables import table_by_split, terminal_tables
from lerobot_wm.workers import map_in_workers

# One policy per worker process, loaded once by `_start_worker`.
_worker_run: Callable[[str], list[Record]]


def _start_worker(cfg: EvaluateConfig, threads: int) -> None:
    global _worker_run
    drop_remarks()
    torch.set_num_threads(threads)
    _worker_run = TaskRunner(cfg).run


def _run_in_worker(task: str) -> list[Record]:
    return _worker_run(task)


def _rollouts(cfg: EvaluateConfig, tasks: list[str]) -> Iterator[list[Record]]:
    """Records task by task, in the order of `tasks`; a single process has its policy when this returns."""
    if cfg.num_workers == 1:
        return map(TaskRunner(cfg).run, tasks)
    workers = min(cfg.num_workers, len(tasks))
    threads = max(1, usable_cores() // workers)
    # LeRobot's progress bars of several processes would overwrite each other, and the parent's. tqdm reads this when a
    # worker imports it: no bar is shown before so many seconds.
    os.environ["TQDM_DELAY"] = "1000000000"
    return map_in_workers(_run_in_worker, tasks, workers, _start_worker, cfg, threads)


def evaluate(cfg: EvaluateConfig) -> list[Record]:
    """Roll out every seed of every task; write records, videos and eval_info.json under `cfg.output_dir`.

    The records file appears when the last rollout is done; until then its lines are in `<name>.part`.

    Raises:
        ValueError: see `EvaluateConfig.validate`.
        FileExistsError, BlockingIOError: see `new_records`.
        ValueError, FileNotFoundError: the checkpoint is not whole, or its processors name code of their own.
    """
    cfg.validate()
    with new_records(cfg.records_file):
        return _evaluate(cfg)


def _evaluate(cfg: EvaluateConfig) -> list[Record]:
    open_checkpoint(cfg.policy.pretrained_path, cfg.policy.pretrained_revision)
    if isinstance(cfg.policy, PolicyConfig):  # small: a broken one is found before environments are built
        make_policy(deepcopy(cfg.policy), env_cfg=cfg.env, rename_map=cfg.rename_map)
    tasks = task_names(cfg)
    revision = cfg.policy.pretrained_revision
    with wandb_run(cfg.wandb, cfg.policy.pretrained_path, cfg.output_dir, revision) as run:
        records = _write_records(cfg, tasks)
        if run is not None:
            log_evaluation(run, cfg.arm_name, records)
    return records


def _write_records(cfg: EvaluateConfig, tasks: list[str]) -> list[Record]:
    started = time.perf_counter()
    cfg.output_dir.mkdir(parents=True, exist_ok=True)
    cfg.records_file.parent.mkdir(parents=True, exist_ok=True)
    unfinished = cfg.records_file.with_name(cfg.records_file.name + ".part")
    records: list[Record] = []
    rollouts = _rollouts(cfg, tasks)  # LeRobot prints as it loads the policy: not into the bar
    total = len(tasks) * len(cfg.seeds)
    # Where there is no terminal, LeRobot's bar beneath this one would leave cursor movements in the file.
    progress = tqdm(total=total, desc="Rolling out", unit="rollout", disable=None)
    with unfinished.open("w") as file, progress:
        for of_task in rollouts:
            records += of_task
            file.writelines(map(record_line, of_task))
            file.flush()
            progress.update(len(of_task))
            if progress.disable:
                logging.info("%d of %d rollouts", len(records), total)
    _write_info(cfg, records, seconds=time.perf_counter() - started)
    unfinished.rename(cfg.records_file)  # last: where it is, all is
    return records


def _write_info(cfg: EvaluateConfig, records: list[Record], seconds: float) -> None:
    """eval_info.json: success rates with intervals per task, per split and overall, and what made them."""

    def chosen(split: str) -> list[Record]:
        return [record for record in records if is_in_split(record, split)]

    tasks = dict.fromkeys(record["task"] for record in records)
    info = {
        "arm": cfg.arm_name,
        "policy_path": str(cfg.policy.pretrained_path),
        "per_task": {task: summarize_success(r for r in records if r["task"] == task) for task in tasks},
        **{split: summarize_success(chosen(split)) for split in ("seen", "unseen") if chosen(split)},
        "overall": summarize_success(records),
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
