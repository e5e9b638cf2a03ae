"""A checkpoint's processors must be whole, and must not name code to run."""

import json
from pathlib import Path
from typing import Any

from lerobot.configs import parser
from lerobot.utils.constants import POLICY_POSTPROCESSOR_DEFAULT_NAME, POLICY_PREPROCESSOR_DEFAULT_NAME

from lerobot_wm.policies.checkpoint import WHOLE, check_tensors, checkpoint_file, read_config


def check_policy_path() -> None:
    """Refuse a checkpoint given by `--policy.path` whose configuration LeRobot's parser would stumble over.

    Raises:
        ValueError, FileNotFoundError: See `read_config`.
    """
    path = parser.get_path_arg("policy")
    if path:
        read_config(path)


def check_processors(checkpoint: str | Path, revision: str | None) -> None:
    """Refuse a checkpoint whose processing steps are not whole, or not LeRobot's registered ones.

    LeRobot imports and calls whatever Python object the files name by its path, such as one that starts programs.

    Args:
        checkpoint: Folder or Hub id.
        revision: Of the Hub; None takes its main branch.

    Raises:
        FileNotFoundError: A file is missing.
        ValueError: A file is damaged, or is no list of registered steps.
    """
    names = [f"{name}.json" for name in (POLICY_PREPROCESSOR_DEFAULT_NAME, POLICY_POSTPROCESSOR_DEFAULT_NAME)]
    paths = [checkpoint_file(checkpoint, name, revision) for name in names]
    states = [step["state_file"] for path in paths if path for step in _steps(path) if "state_file" in step]
    paths += [checkpoint_file(checkpoint, name, revision) for name in states]
    for name, path in zip(names + states, paths, strict=True):
        if path is None:
            raise FileNotFoundError(f"{checkpoint} has no {name}, a part of its processors: {WHOLE}.")
        if name in states:
            check_tensors(path)


def _steps(path: Path) -> list[dict[str, Any]]:
    """The steps that a file lists."""
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
    return steps
