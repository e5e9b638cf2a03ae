"""The command that repeats a training run, from the run's configuration."""

import json
import re
import shlex
from dataclasses import MISSING, fields, is_dataclass, replace
from pathlib import Path
from typing import Any

import draccus
from draccus import cfgparsing
from huggingface_hub.errors import HFValidationError
from lerobot.configs import PreTrainedConfig
from lerobot.configs.default import DatasetConfig
from lerobot.configs.train import TrainPipelineConfig

from lerobot_wm.data.latents import LatentRecord

# Filled in when a policy is created, from its dataset, its world model or its checkpoint.
_FILLED_IN = {
    "policy.input_features",
    "policy.output_features",
    "policy.use_peft",
    "policy.tasks",
    "policy.trained_tasks",
    "policy.relative_indices",
    "policy.rssm.image_channels",
    "policy.rssm.action_dim",
    "policy.rssm.proprio_dim",
    "policy.world_model",
    "policy.world_model_fingerprint",
    "policy.iql.trained_betas",
}
# Settings of the machine and the Hub, of logs, checkpoints and evaluation: they do not change what is learned.
_NO_MATTER = {
    "policy.device",
    "policy.push_to_hub",
    "policy.repo_id",
    "policy.private",
    "policy.tags",
    "policy.license",
    "dataset.root",
    "dataset.video_backend",
    "output_dir",
    "job_name",
    "job",
    "resume",
    "num_workers",
    "prefetch_factor",
    "persistent_workers",
    "dataloader_multiprocessing_context",
    "env",
    "env_eval_freq",
    "eval",
    "log_freq",
    "save_checkpoint",
    "save_checkpoint_to_hub",
    "save_freq",
    "wandb",
}
# Written by `train_command` and `_policy_flags`.
_OF_THEIR_OWN = {
    "policy",
    "policy.pretrained_path",
    "policy.pretrained_revision",
    "dataset",
    "use_policy_training_preset",
    "optimizer",
    "scheduler",
}
_LEFT_OUT = _FILLED_IN | _NO_MATTER | _OF_THEIR_OWN
# Shown even at their defaults.
_ALWAYS = ("batch_size", "steps", "seed")


def train_command(cfg: TrainPipelineConfig, latents: LatentRecord | None) -> str:
    """A `lerobot-wm train` command with every flag that matters to the result and is not at its default.

    Paths on the machine that trained are left out: they are private, and useless elsewhere.

    Args:
        cfg: The run's configuration; it trained a policy.
        latents: The record of its dataset, if it was one of latents: the command encodes their source.
    """
    flags = _policy_flags(cfg.policy, cfg.resume)
    dataset = cfg.dataset
    if latents is not None:
        dataset = replace(dataset, repo_id=latents.source_repo_id, revision=None)
    flags |= _changed(dataset, vars(DatasetConfig(repo_id="")), "dataset.")
    if not cfg.use_policy_training_preset:
        flags["use_policy_training_preset"] = False
        for name, setting in {"optimizer": cfg.optimizer, "scheduler": cfg.scheduler}.items():
            flags |= {f"{name}.type": setting.type, **_changed(setting, {}, f"{name}.")}
    usual = {name: value for name, value in _defaults(TrainPipelineConfig).items() if name not in _ALWAYS}
    flags |= _changed(cfg, usual)
    # LeRobot pushes by default, and then needs a repository.
    flags["policy.push_to_hub"] = False
    return " ".join(
        ["lerobot-wm train", *(shlex.quote(f"--{key}={_text(value)}") for key, value in flags.items())]
    )


def _policy_flags(policy: PreTrainedConfig, resumed: bool) -> dict[str, object]:
    """The policy's type or checkpoint, and its own settings that differ from the defaults there."""
    # A resumed run loads its own checkpoint.
    if policy.pretrained_path is None or resumed:
        flags = {"policy.type": policy.type, **_changed(policy, _defaults(type(policy)), "policy.")}
    else:
        flags = {"policy.path": _public(policy.pretrained_path, "CHECKPOINT")}
        if policy.pretrained_revision is not None:
            flags["policy.pretrained_revision"] = policy.pretrained_revision
        flags |= _changed(policy, _settings_of_checkpoint(policy), "policy.")
        flags.pop("policy.world_model_path", None)  # the world model is in the checkpoint
    if hasattr(policy, "world_model_path"):
        flags.pop("policy.image_key", None)  # its world model's
    return flags


def _settings_of_checkpoint(policy: PreTrainedConfig) -> dict[str, Any]:
    """The settings of the checkpoint that training started from; empty if it is no longer here."""
    try:
        return vars(
            PreTrainedConfig.from_pretrained(
                policy.pretrained_path, revision=policy.pretrained_revision, local_files_only=True
            )
        )
    except (FileNotFoundError, HFValidationError):
        return {}


def _changed(config: Any, usual: dict[str, Any], prefix: str = "") -> dict[str, object]:
    """Settings that differ from the usual ones or have no usual value, under dotted names."""
    flags: dict[str, object] = {}
    for item in fields(config):
        key, value = prefix + item.name, getattr(config, item.name)
        if not item.init or key in _LEFT_OUT:
            continue
        if is_dataclass(value):
            known = usual.get(item.name)
            flags |= _changed(value, {} if known is None else vars(known), f"{key}.")
        elif item.name not in usual or draccus.encode(value) != draccus.encode(usual[item.name]):
            is_place = item.name.endswith("_path") and value is not None
            flags[key] = _public(value, item.name.removesuffix("_path").upper()) if is_place else value
    return flags


def _defaults(kind: type) -> dict[str, Any]:
    """Defaults of a configuration class; an instance would fill in what fits this machine."""
    defaults = {}
    for item in fields(kind):
        if item.default is not MISSING:
            defaults[item.name] = item.default
        elif item.default_factory is not MISSING:
            defaults[item.name] = item.default_factory()
    return defaults


def _public(path: str | Path, name: str) -> str:
    """A Hub id, user/name or user/name@revision, unchanged; a placeholder instead of a folder."""
    is_hub_id = re.fullmatch(r"[\w-][\w.-]*/[\w.-]+(@.+)?", str(path)) is not None
    return str(path) if is_hub_id and not Path(path).exists() else name


def _text(value: object) -> str:
    """A value as draccus reads it from the command line."""
    if isinstance(value, str):
        is_plain = re.fullmatch(r"([A-Za-z]|[0-9a-f]{40})[\w./@,-]*", value) is not None
        if is_plain and cfgparsing.parse_string(value) == value:  # not null, yes or the like
            return value
    return json.dumps(draccus.encode(value))
