"""Dreams and tables of evaluations, logged to the Weights & Biases run that holds a checkpoint's losses."""

from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import TYPE_CHECKING

from lerobot.configs.default import WandBConfig
from lerobot.utils.import_utils import require_package

from lerobot_wm.records import Record, is_in_split, present_splits, summarize_success
from lerobot_wm.tables import cell_text, table_by_split
from lerobot_wm.train.resume import training_config

if TYPE_CHECKING:
    import wandb  # takes seconds to import, which only those wait for who log to it


@contextmanager
def wandb_run(
    cfg: WandBConfig, policy_path: Path | None, folder: Path, revision: str | None = None
) -> Iterator["wandb.Run | None"]:
    """The run to log to: the one that trained the checkpoint, else, where that logged nothing, a new one.

    Args:
        cfg: LeRobot's `--wandb.*` flags. With a `run_id` that run is taken. Without `mode` it is that of the training.
        policy_path: The checkpoint: folder or Hub id.
        folder: Where wandb keeps its files.
        revision: The checkpoint's branch, tag or commit on the Hub.

    Yields:
        The run; None without `--wandb.enable=true`.

    Raises:
        ImportError: wandb is not installed.
        RuntimeError: wandb takes no run: there is no login, no network, or no such mode.
    """
    if not cfg.enable:
        yield None
        return
    require_package("wandb", extra="training")
    import wandb

    trained = WandBConfig(**training_config(policy_path, revision).get("wandb", {}))
    chosen = trained if trained.run_id is not None and cfg.run_id is None else cfg
    folder.mkdir(parents=True, exist_ok=True)
    try:
        run = wandb.init(
            project=chosen.project,
            entity=chosen.entity,
            id=chosen.run_id,
            resume="allow",
            mode=cfg.mode or chosen.mode,
            dir=folder,
            settings=wandb.Settings(silent=True),  # as in LeRobot's training
        )
    except (wandb.Error, ValueError) as error:
        raise RuntimeError(
            f"wandb takes no run ({error}): log in with `wandb login`, or give --wandb.mode=offline."
        ) from error
    print(f"wandb: {run.settings.sync_dir if run.offline else run.url}")
    try:
        yield run
    finally:
        run.finish()  # an error here is no failure of the training, which is what the run stands for


def log_evaluation(run: "wandb.Run", arm: str, records: list[Record]) -> None:
    """Log the success table, a table of the rollouts, and success per cent of each split.

    Args:
        run: Where to.
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
