"""Resuming a run that was killed, perhaps while it wrote a checkpoint.

LeRobot writes a checkpoint's files one by one into its folder, the state of the optimizer or, where there is one, of
the scheduler last; then it removes the link `last` and sets it again. A kill leaves at most one unfinished folder,
later than the one that `last` names, or no link.
"""

import json
import logging
import shutil
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from pathlib import Path

from lerobot.configs.train import TRAIN_CONFIG_NAME
from lerobot.utils.constants import (
    CHECKPOINTS_DIR,
    LAST_CHECKPOINT_LINK,
    OPTIMIZER_PARAM_GROUPS,
    PRETRAINED_MODEL_DIR,
    SCHEDULER_STATE,
    TRAINING_STATE_DIR,
    TRAINING_STEP,
)

from lerobot_wm.errors import disk_problem

logger = logging.getLogger(__name__)


def settings_in(config_path: Path) -> Path:
    """The `train_config.json` of a run's folder, of its `checkpoints`, or of one of these; other paths as they are."""
    if not config_path.is_dir():
        return config_path
    place = config_path
    if (place / CHECKPOINTS_DIR).is_dir():
        place /= CHECKPOINTS_DIR
    if place.name == CHECKPOINTS_DIR:
        place /= LAST_CHECKPOINT_LINK
    # The link may have to be restored first.
    if place.name == LAST_CHECKPOINT_LINK or (place / PRETRAINED_MODEL_DIR).is_dir():
        place /= PRETRAINED_MODEL_DIR
    return place / TRAIN_CONFIG_NAME


def restore_last(config_path: Path) -> None:
    """Set `checkpoints/last` again where a kill fell between its removal and its setting.

    Args:
        config_path: `--config_path`. Nothing is done unless it is a run's `train_config.json`.

    Raises:
        FileNotFoundError: There is no such file, and no checkpoint that the link could name.
    """
    link = _link_in(config_path)
    if link is not None and not link.exists() and (checkpoint := _newest_complete(link.parent)) is not None:
        link.unlink(missing_ok=True)  # it may name what is no longer there
        with suppress(FileExistsError):  # another process of this run was faster
            link.symlink_to(checkpoint.name)
        logger.warning("%s was missing, as a kill can leave it. It is %s now.", link, checkpoint.name)
    if config_path.name == TRAIN_CONFIG_NAME and not config_path.is_file():
        raise FileNotFoundError(
            f"{config_path} not found. --config_path takes the folder of a run, one of its checkpoints, or a "
            f"{TRAIN_CONFIG_NAME}. A run that stopped before its first checkpoint cannot be resumed: remove its folder "
            "and start it again without --resume."
        )


def can_resume(config_path: Path) -> bool:
    """Whether training resumes from `.../checkpoints/last/pretrained_model/train_config.json`, once `last` is set."""
    link = _link_in(config_path)
    return config_path.exists() or (link is not None and _newest_complete(link.parent) is not None)


def clear_unfinished(checkpoint: Path, output_dir: Path) -> None:
    """Remove what a killed run left of a checkpoint. Training must not write over finished ones.

    Args:
        checkpoint: What training resumes from.
        output_dir: Where it writes.

    Raises:
        FileNotFoundError: The checkpoint itself is incomplete.
        FileExistsError: The folder holds later complete checkpoints: up to that which `last` names, or more than the
            one that a kill can leave beyond it.
    """
    if not is_complete(checkpoint):
        raise FileNotFoundError(
            f"{checkpoint} is incomplete: a run was killed while it wrote it, or files of it were removed. Resume from "
            f"{checkpoint.with_name(LAST_CHECKPOINT_LINK)}."
        )
    folder = output_dir / CHECKPOINTS_DIR
    last = folder / LAST_CHECKPOINT_LINK
    step = _step_of(checkpoint)
    finished = _step_of(last) if last.exists() else 0
    later = [saved for saved in _numbered(folder) if int(saved.name) > step]
    complete = [saved.name for saved in later if is_complete(saved)]
    kept = [saved.name for saved in later if int(saved.name) <= finished]
    if kept or len(complete) > 1:
        raise FileExistsError(
            f"{folder} holds later checkpoints ({', '.join(kept or complete)}), which training from step {step} would "
            f"overwrite. Resume from {last}, give another --output_dir, or remove them."
        )
    for saved in later:
        shutil.rmtree(saved)


@contextmanager
def explain_how_to_resume(output_dir: Path) -> Iterator[None]:
    """Have Ctrl-C and a full disk say how the run in a folder is resumed.

    Raises:
        KeyboardInterrupt: On Ctrl-C.
        OSError: The disk cannot be written.
    """
    try:
        yield
    except KeyboardInterrupt:
        raise KeyboardInterrupt(_how_to_resume(output_dir)) from None
    except Exception as error:
        problem = disk_problem(error)
        if problem is None:
            raise
        raise OSError(f"{problem}; then {_how_to_resume(output_dir)}.") from error


def is_complete(checkpoint: Path) -> bool:
    """Whether a checkpoint has its step, and the file that LeRobot writes last into it."""
    try:
        _step_of(checkpoint)
        config = json.loads((checkpoint / PRETRAINED_MODEL_DIR / TRAIN_CONFIG_NAME).read_text())
        written_last = SCHEDULER_STATE if config["scheduler"] is not None else OPTIMIZER_PARAM_GROUPS
        json.loads((checkpoint / TRAINING_STATE_DIR / written_last).read_text())
    except (OSError, ValueError, KeyError, TypeError):
        return False
    return True


def _how_to_resume(output_dir: Path) -> str:
    """The end of a sentence."""
    last = output_dir / CHECKPOINTS_DIR / LAST_CHECKPOINT_LINK
    if not last.exists() and _newest_complete(last.parent) is None:
        return f"there is no checkpoint yet: remove {output_dir} and run the same command again"
    settings = last / PRETRAINED_MODEL_DIR / TRAIN_CONFIG_NAME
    return f"resume with `lerobot-wm train --config_path={settings} --resume=true`"


def _link_in(path: Path) -> Path | None:
    """The `checkpoints/last` that a path leads through."""
    places = (path, *path.parents)
    return next(
        (p for p in places if (p.parent.name, p.name) == (CHECKPOINTS_DIR, LAST_CHECKPOINT_LINK)), None
    )


def _newest_complete(checkpoints: Path) -> Path | None:
    return next((saved for saved in reversed(_numbered(checkpoints)) if is_complete(saved)), None)


def _numbered(checkpoints: Path) -> list[Path]:
    """Folders of checkpoints, earliest first."""
    return sorted((path for path in checkpoints.glob("*") if path.name.isdigit()), key=lambda p: int(p.name))


def _step_of(checkpoint: Path) -> int:
    return json.loads((checkpoint / TRAINING_STATE_DIR / TRAINING_STEP).read_text())["step"]
