"""The command that trains a policy as a run did, read from the run's configuration."""

import json
import shlex
from dataclasses import fields
from pathlib import Path
from typing import Any

import draccus
from lerobot.configs import PreTrainedConfig
from lerobot.configs.train import TrainPipelineConfig

from lerobot_wm.data.latents import LatentRecord

# Filled in when a policy is made, from its dataset or its world model; or of the machine.
_NOT_CHOSEN = {
    "tasks",
    "image_key",
    "rssm.image_channels",
    "rssm.action_dim",
    "rssm.proprio_dim",
    "rssm.predict_reward",
    "world_model_fingerprint",
    "trained_betas",
    "normalization_mapping",
    "dtype",
}
# Of every policy: the Hub's settings and the machine's, not the method's.
_INHERITED = {field.name for field in fields(PreTrainedConfig)}


def train_command(cfg: TrainPipelineConfig, latents: LatentRecord | None) -> str:
    """A `lerobot-wm train` command line with every flag that matters to the result and is not at its default.

    Places on the machine that trained are left out: they help no one and are nobody's business.

    Args:
        cfg: Of the run; it trained a policy.
        latents: Of its dataset, where that holds latents: the command encodes their source.
    """
    flags: dict[str, object] = {}
    # A run that is gone on with loads its own checkpoint.
    if cfg.policy.pretrained_path is None or cfg.resume:
        flags["policy.type"] = cfg.policy.type
    else:
        flags["policy.path"] = _public(cfg.policy.pretrained_path, "CHECKPOINT")
        if cfg.policy.pretrained_revision is not None:
            flags["policy.pretrained_revision"] = cfg.policy.pretrained_revision
    flags |= _policy_flags(cfg.policy)
    cameras = getattr(cfg.policy, "image_key", None)
    # Those of a policy on latents are its world model's; all that there are need not be named.
    if (
        cameras
        and not hasattr(cfg.policy, "world_model_path")
        and cameras != ",".join(cfg.policy.image_features)
    ):
        flags["policy.image_key"] = cameras
    if cfg.rename_map:
        flags["rename_map"] = json.dumps(cfg.rename_map)
    flags["dataset.repo_id"] = cfg.dataset.repo_id if latents is None else latents.source_repo_id
    if cfg.dataset.revision is not None and latents is None:
        flags["dataset.revision"] = cfg.dataset.revision
    if cfg.dataset.episodes is not None:
        flags["dataset.episodes"] = cfg.dataset.episodes
    flags |= {"batch_size": cfg.batch_size, "steps": cfg.steps, "seed": cfg.seed}
    return " ".join(
        ["lerobot-wm train", *(shlex.quote(f"--{key}={_text(value)}") for key, value in flags.items())]
    )


def _policy_flags(policy: PreTrainedConfig) -> dict[str, object]:
    """The policy's own settings that are not at their defaults."""
    chosen, default = draccus.encode(policy), draccus.encode(type(policy)(device=policy.device))
    flat, flat_default = _flatten(chosen), _flatten(default)
    flags = {
        f"policy.{key}": value
        for key, value in flat.items()
        if key in flat_default and value != flat_default[key] and key.split(".")[0] not in _INHERITED
    }
    flags = {key: value for key, value in flags.items() if key.removeprefix("policy.") not in _NOT_CHOSEN}
    if "policy.world_model_path" in flags:
        flags["policy.world_model_path"] = _public(str(flags["policy.world_model_path"]), "WORLD_MODEL")
    return flags


def _public(path: str | Path, name: str) -> str:
    """A Hub id as it is; a name in place of a folder."""
    return name if Path(path).exists() else str(path)


def _flatten(settings: dict[str, Any], prefix: str = "") -> dict[str, object]:
    """Nested settings under dotted names."""
    flat: dict[str, object] = {}
    for key, value in settings.items():
        if isinstance(value, dict):
            flat |= _flatten(value, f"{prefix}{key}.")
        else:
            flat[prefix + key] = value
    return flat


def _text(value: object) -> str:
    return str(value).lower() if isinstance(value, bool) else str(value)
