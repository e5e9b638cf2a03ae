"""What lies beside a checkpoint about the run that trained it."""

import json
from pathlib import Path
from typing import Any

from huggingface_hub import hf_hub_download
from huggingface_hub.errors import EntryNotFoundError
from lerobot.configs.train import TRAIN_CONFIG_NAME


def training_config(policy_path: Path | None) -> dict[str, Any]:
    """The settings of the run that trained a checkpoint (folder or Hub id); empty where it does not tell."""
    if policy_path is None:
        return {}
    file = policy_path / TRAIN_CONFIG_NAME
    if not policy_path.is_dir():
        try:
            file = Path(hf_hub_download(str(policy_path), TRAIN_CONFIG_NAME))
        except EntryNotFoundError:
            return {}
    return json.loads(file.read_text()) if file.exists() else {}
