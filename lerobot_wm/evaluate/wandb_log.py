"""Logging to the Weights & Biases run that trained a checkpoint."""

import json
import logging
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import TYPE_CHECKING, Any

from huggingface_hub.errors import LocalEntryNotFoundError
from lerobot.configs.default import WandBConfig
from lerobot.configs.train import TRAIN_CONFIG_NAME
from lerobot.utils.import_utils import require_package

from lerobot_wm.policies.common.checkpoint import checkpoint_file
from lerobot_wm.records import Record, is_in_split, present_splits, summarize_success
from lerobot_wm.tables import cell_text, table_by_split

if TYPE_CHECKING:
    # Takes seconds to import, and only some users log to it.
    import wandb

logger = logging.getLogger(__name__)


def training_config(policy_path: Path, revision: str | None = None) -> dict[str, Any]:
    """Settings of the run that trained a checkpoint (folder or Hub id); empty if the checkpoint lacks them."""
    try:
        file = checkpoint_file(policy_path, TRAIN_CONFIG_NAME, revision)
    except LocalEntryNotFoundError:  # offline, with a cached checkpoint
        logger.warning(
            "%s of %s is not on this machine, and the Hub is unreachable.", TRAIN_CONFIG_NAME, policy_path
        )
        return {}
    return {} if file is None else json.loads(file.read_text())


@contextmanager
def wandb_run(
    cfg: WandBConfig, policy_path: Path, folder: Path, revision: str | None = None
) -> Iterator["wandb.Run | None"]:
    """Open the wandb run that trained a checkpoint, or a new one if that training did not log to wandb.

    Args:
        cfg: LeRobot's `--wandb.*` flags. `run_id` selects another run. Without `mode` the training's mode is used.
        policy_path: Folder or Hub id of the checkpoint.
        folder: Folder for wandb's files.
        revision: Branch, tag or commit of the checkpoint on the Hub.

    Yields:
        The run; None without `--wandb.enable=true`.
    """
    if not cfg.enable:
        yield None
        return
    require_package("wandb", extra="training")
    import wandb

    trained = WandBConfig(**training_config(policy_path, revision).get("wandb", {}))
    chosen = trained if trained.run_id is not None and cfg.run_id is None else cfg
    folder.mkdir(parents=True, exist_ok=True)
    run = wandb.init(
        project=chosen.project,
        entity=chosen.entity,
        id=chosen.run_id,
        resume="allow",
        mode=cfg.mode or chosen.mode,
        dir=folder,
        # As in LeRobot's training.
        settings=wandb.Settings(silent=True),
    )
    print(f"wandb: {run.settings.sync_dir if run.offline else run.url}")
    try:
        yield run
    finally:
        # Without an exit code: an error here does not mean that the training failed.
        run.finish()


def log_evaluation(run: "wandb.Run", arm: str, records: list[Record]) -> None:
    """Log the success table, a table of rollouts, and the success rate in per cent of each split.

    Args:
        run: The run.
        arm: Name of the method.
        records: One for each rollout; at least one.
    """
    import wandb

    success = table_by_split(f"Success of {arm}", records)
    rows = [[label, *map(cell_text, cells)] for label, cells in success.rows]
    rollouts = [list(record.values()) for record in records]
    per_cent = {
        f"eval/pc_success_{split}": summarize_success(r for r in records if is_in_split(r, split))[
            "pc_success"
        ]
        for split in present_splits(records)
    }
    run.log(
        {
            "eval/success": wandb.Table(columns=[success.corner, *success.columns], data=rows),
            "eval/rollouts": wandb.Table(columns=list(records[0]), data=rollouts),
            **per_cent,
        }
    )
