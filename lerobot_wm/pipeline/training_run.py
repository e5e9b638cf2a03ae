"""What lies beside a checkpoint about the run that trained it."""

import json
from pathlib import Path
from typing import Any

from huggingface_hub import hf_hub_download
from huggingface_hub.errors import EntryNotFoundError
from lerobot.configs.train import TRAIN_CONFIG_NAME


def training_config(policy_path: Path | None) -> dict[str, Any]:
    """The settings of the run that trained a checkpoint (folder or Hub id); empty where it does not tell."""
    file = None if policy_path is None else checkpoint_file(policy_path, TRAIN_CONFIG_NAME)
    return {} if file is None else json.loads(file.read_text())


def checkpoint_file(checkpoint: str | Path, name: str, revision: str | None = None) -> Path | None:
    """A file of a checkpoint; None where it has no such file.

    Args:
        checkpoint: Folder or Hub id.
        name: Of the file.
        revision: Of the Hub; None takes its main branch.
    """
    path = Path(checkpoint) / name
    if Path(checkpoint).is_dir():
        return path if path.is_file() else None
    try:
        return Path(hf_hub_download(str(checkpoint), name, revision=revision))
    except EntryNotFoundError:
        return None
