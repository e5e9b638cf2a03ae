"""A checkpoint's processors must not name code to run."""

import json
from pathlib import Path

from lerobot.utils.constants import POLICY_POSTPROCESSOR_DEFAULT_NAME, POLICY_PREPROCESSOR_DEFAULT_NAME

from lerobot_wm.pipeline.training_run import checkpoint_file


def check_processors(checkpoint: str | Path, revision: str | None) -> None:
    """Refuse a checkpoint whose processing steps are not LeRobot's registered ones.

    LeRobot imports and calls whatever Python object the files name by its path, such as one that starts programs.

    Args:
        checkpoint: Folder or Hub id.
        revision: Of the Hub; None takes its main branch.

    Raises:
        ValueError: A file is no list of registered steps.
    """
    for name in (POLICY_PREPROCESSOR_DEFAULT_NAME, POLICY_POSTPROCESSOR_DEFAULT_NAME):
        path = checkpoint_file(checkpoint, f"{name}.json", revision)
        if path is not None:
            _check(path)


def _check(path: Path) -> None:
    try:
        steps = json.loads(path.read_text(encoding="utf-8"))["steps"]
        registered = all(isinstance(step["registry_name"], str) for step in steps)
    except (ValueError, KeyError, TypeError, RecursionError):
        registered = False
    if not registered:
        raise ValueError(
            f"{path} does not name every processing step by its registry_name: it is damaged, or would have a Python "
            "object of its choice called. Use a checkpoint you trust, written by LeRobot."
        )
