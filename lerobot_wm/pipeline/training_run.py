"""What lies beside a checkpoint about the run that trained it."""

import json
import logging
from pathlib import Path
from typing import Any

from huggingface_hub.errors import LocalEntryNotFoundError
from lerobot.configs.train import TRAIN_CONFIG_NAME, TrainPipelineConfig
from lerobot.utils.constants import (
    OPTIMIZER_STATE,
    RNG_STATE,
    TRAINING_STATE_DIR,
    TRAINING_STEP,
)

from lerobot_wm.pipeline.train_resume import is_whole
from lerobot_wm.policies.checkpoint import WHOLE, check_tensors, checkpoint_file, read_json

logger = logging.getLogger(__name__)


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
