"""Going on with a training that was killed, perhaps while it wrote a checkpoint.

LeRobot writes a checkpoint's files one by one into its folder, the state of the optimizer or, where there is one, of
the scheduler last; then it removes the link `last` and sets it again. A kill leaves at most one folder that is not
whole, later than the one that `last` names, or no link.
"""

import json
import logging
import shutil
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from pathlib import Path
from typing import Any

from huggingface_hub.errors import LocalEntryNotFoundError
from lerobot.common.train_utils import load_training_step
from lerobot.configs.train import TRAIN_CONFIG_NAME, TrainPipelineConfig
from lerobot.utils.constants import (
    CHECKPOINTS_DIR,
    LAST_CHECKPOINT_LINK,
    OPTIMIZER_PARAM_GROUPS,
    OPTIMIZER_STATE,
    PRETRAINED_MODEL_DIR,
    RNG_STATE,
    SCHEDULER_STATE,
    TRAINING_STATE_DIR,
    TRAINING_STEP,
)

from lerobot_wm.errors import disk_problem
from lerobot_wm.policies.common.checkpoint import WHOLE, check_tensors, checkpoint_file, read_json

logger = logging.getLogger(__name__)


def restore_last(config_path: str) -> None:
    """Set `checkpoints/last` again where a kill fell between its removal and its setting.

    Args:
        config_path: What training is to go on from; nothing is done unless it leads through a `checkpoints/last`.

    Raises:
        FileNotFoundError: There is no such link, and no checkpoint that it could name.
    """
    link = _link_of(Path(config_path))
    if link is not None and not _is_set(link):
        raise FileNotFoundError(
            f"{link} is missing, and there is no whole checkpoint beside it: a training that was killed before its "
            f"first begins again, without --resume; remove {link.parent.parent} before that."
        )


def can_resume(config_path: Path) -> bool:
    """Whether training can resume from `.../checkpoints/last/pretrained_model/train_config.json`; writes nothing."""
    link = _link_of(config_path)
    if link is None or link.exists():
        return config_path.exists()
    return any(map(is_whole, _numbered(link.parent)))


def clear_unfinished(checkpoint: Path, output_dir: Path) -> None:
    """Remove what a killed run left of a checkpoint; refuse where training would write over finished ones.

    Args:
        checkpoint: What training goes on from.
        output_dir: Where it writes.

    Raises:
        FileNotFoundError: The checkpoint itself is not whole.
        FileExistsError: The folder holds later checkpoints that are whole: up to that which `last` names, or more than
            the one that a kill can leave beyond it.
    """
    if not is_whole(checkpoint):
        raise FileNotFoundError(
            f"{checkpoint} does not hold all of a training's state: it was being written when a run was killed, or "
            f"files of it were removed. Go on from {checkpoint.with_name(LAST_CHECKPOINT_LINK)}."
        )
    folder = output_dir / CHECKPOINTS_DIR
    last = folder / LAST_CHECKPOINT_LINK
    step = load_training_step(checkpoint / TRAINING_STATE_DIR)
    finished = load_training_step(last / TRAINING_STATE_DIR) if _is_set(last) else 0
    later = [saved for saved in _numbered(folder) if int(saved.name) > step]
    whole = [saved.name for saved in later if is_whole(saved)]
    kept = [saved.name for saved in later if int(saved.name) <= finished]
    if kept or len(whole) > 1:
        raise FileExistsError(
            f"{folder} holds later checkpoints, {', '.join(kept or whole)}, which training on from step {step} would "
            f"write over: go on from {last}, give another --output_dir, or remove them."
        )
    for saved in later:
        shutil.rmtree(saved)


def how_to_go_on(output_dir: Path) -> str:
    """What to do about a training that stopped early, as the end of a sentence."""
    last = output_dir / CHECKPOINTS_DIR / LAST_CHECKPOINT_LINK
    if not _is_set(last):
        return f"there is no checkpoint yet: remove {output_dir} and give the same command again"
    settings = last / PRETRAINED_MODEL_DIR / TRAIN_CONFIG_NAME
    return f"go on with `lerobot-wm train --config_path={settings} --resume=true`"


@contextmanager
def stops_explained(output_dir: Path) -> Iterator[None]:
    """Have Ctrl-C, and a disk that takes no more, say how the training in a folder goes on.

    Raises:
        KeyboardInterrupt: On Ctrl-C.
        OSError: The disk refused to be written.
    """
    try:
        yield
    except KeyboardInterrupt:
        raise KeyboardInterrupt(how_to_go_on(output_dir)) from None
    except Exception as error:
        problem = disk_problem(error)
        if problem is None:
            raise
        raise OSError(f"{problem}; then {how_to_go_on(output_dir)}.") from error


def is_whole(checkpoint: Path) -> bool:
    """Whether the file that LeRobot writes last into a checkpoint is there, and whole."""
    try:
        config = json.loads((checkpoint / PRETRAINED_MODEL_DIR / TRAIN_CONFIG_NAME).read_text())
        written_last = SCHEDULER_STATE if config["scheduler"] is not None else OPTIMIZER_PARAM_GROUPS
        json.loads((checkpoint / TRAINING_STATE_DIR / written_last).read_text())
    except (OSError, ValueError, KeyError):
        return False
    return True


def _numbered(checkpoints: Path) -> list[Path]:
    """Folders of checkpoints, earliest first."""
    return sorted((path for path in checkpoints.glob("*") if path.name.isdigit()), key=lambda p: int(p.name))


def _link_of(path: Path) -> Path | None:
    """The `checkpoints/last` that a path leads through."""
    places = (path, *path.parents)
    return next(
        (p for p in places if (p.parent.name, p.name) == (CHECKPOINTS_DIR, LAST_CHECKPOINT_LINK)), None
    )


def _is_set(last: Path) -> bool:
    """Whether the link names a checkpoint; where it does not, it is set to the newest whole one, if there is any."""
    if last.exists():
        return True
    whole = [checkpoint for checkpoint in _numbered(last.parent) if is_whole(checkpoint)]
    if not whole:
        return False
    last.unlink(missing_ok=True)  # it may name what is no longer there
    with suppress(FileExistsError):  # another process of this training was faster
        last.symlink_to(whole[-1].name)
    logger.warning("%s was missing, as a kill can leave it: it is %s now.", last, whole[-1].name)
    return True


def training_config(policy_path: Path | None, revision: str | None = None) -> dict[str, Any]:
    """The settings of the run that trained a checkpoint (folder or Hub id); empty where it does not tell."""
    try:
        file = None if policy_path is None else checkpoint_file(policy_path, TRAIN_CONFIG_NAME, revision)
    except LocalEntryNotFoundError:  # the rest of the checkpoint is here
        logger.warning("%s of %s is not here, nor can the Hub be reached.", TRAIN_CONFIG_NAME, policy_path)
        return {}
    return {} if file is None else json.loads(file.read_text())


def check_run_settings(config_path: str) -> None:
    """Refuse to go on with a run whose settings are missing, damaged or of another release.

    Args:
        config_path: `--config_path` of the command line: a checkpoint's `train_config.json` or its folder; others are
            left to LeRobot.

    Raises:
        FileNotFoundError: They are missing.
        ValueError: They cannot be read.
    """
    path = Path(config_path)
    if path.is_dir():
        path /= TRAIN_CONFIG_NAME
    if path.name != TRAIN_CONFIG_NAME:
        return
    if not path.is_file():
        raise FileNotFoundError(f"{path} is missing, the settings of the run to go on with: {WHOLE}.")
    read_json(path)
    try:
        TrainPipelineConfig.from_pretrained(path)
    except Exception as error:  # draccus and the types' own checks raise all kinds
        raise ValueError(
            f"{path} holds settings that are unknown here: {error}. It was changed by hand, or a newer release wrote "
            "it: upgrade lerobot and lerobot_policy_wm to the versions that wrote it."
        ) from error


def check_training_state(checkpoint: Path) -> None:
    """Refuse to go on from a checkpoint whose training state is damaged.

    One that a kill left unfinished is for `clear_unfinished` to speak of.

    Args:
        checkpoint: Folder that holds `pretrained_model` and `training_state`.

    Raises:
        FileNotFoundError: A file of it is missing.
        ValueError: A file of it was cut short, or the optimizer's state is not finite.
    """
    if not is_whole(checkpoint):
        return
    folder = checkpoint / TRAINING_STATE_DIR
    step = folder / TRAINING_STEP
    if not step.is_file():
        raise FileNotFoundError(f"{step} is missing, which tells how far the training is: {WHOLE}.")
    content = read_json(step)
    if not isinstance(content, dict) or not isinstance(content.get("step"), int):
        raise ValueError(f"{step} names no step, a whole number: it is damaged; {WHOLE}.")
    for name in (OPTIMIZER_STATE, RNG_STATE):
        check_tensors(folder / name)
