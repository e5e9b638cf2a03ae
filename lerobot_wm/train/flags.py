"""Flags of `lerobot-wm train` that would fail late or change nothing, found before any work is done."""

import os
import shutil
from collections.abc import Collection
from pathlib import Path
from typing import Any

import torch
from lerobot.configs.train import TRAIN_CONFIG_NAME, TrainPipelineConfig
from lerobot.datasets.dataset_metadata import LeRobotDatasetMetadata
from lerobot.utils.constants import CHECKPOINTS_DIR, PRETRAINED_MODEL_DIR

from lerobot_wm.policies.common.checkpoint import read_json
from lerobot_wm.policies.common.config import PolicyConfig

# Flags that decide the optimizer and its schedule.
_OPTIMIZER_FLAGS = ("optimizer.", "scheduler.", "use_policy_training_preset")
_POLICY_OPTIMIZER_FLAGS = ("policy.lr", "policy.optimizer_", "policy.scheduler_")
# LeRobot reads it at every step, also in a resumed run.
_CLIPPING = "optimizer.grad_clip_norm"


def flag_names(arguments: Collection[str]) -> list[str]:
    """The names of the flags among command-line arguments, without dashes and values."""
    return [argument[2:].split("=")[0] for argument in arguments if argument.startswith("--")]


def check_flags(cfg: TrainPipelineConfig, given: Collection[str]) -> None:
    """Check the settings of a run that need no dataset.

    Args:
        cfg: The settings, after LeRobot has validated them.
        given: Names of the flags on the command line.

    Raises:
        ValueError: A setting is out of range, cannot work here, or is a flag without effect.
    """
    for name, lowest in {"batch_size": 1, "steps": 1, "num_workers": 0}.items():
        if getattr(cfg, name) < lowest:
            raise ValueError(f"--{name}={getattr(cfg, name)}: expected at least {lowest}.")
    if cfg.dataset.episodes == []:
        raise ValueError("--dataset.episodes=[] leaves no data: leave the flag out to train on all episodes.")
    if cfg.dataset.image_transforms.enable:
        raise ValueError(
            "--dataset.image_transforms.enable=true has no effect on frames served from RAM: turn it off, or train "
            "with lerobot-train."
        )
    if isinstance(cfg.policy, PolicyConfig):
        for name in ("peft", "sample_weighting"):
            if getattr(cfg, name) is not None:
                raise ValueError(f"--{name}: {cfg.policy.type} has no use for it. Leave its flags out.")
        if cfg.policy.compile_model:
            check_compiler(torch.device(cfg.policy.device).type)
    if cfg.resume:
        _check_resumed_optimizer(cfg, given)
        return
    of_policy = [name for name in given if name.startswith(_POLICY_OPTIMIZER_FLAGS)]
    if of_policy and not cfg.use_policy_training_preset:
        raise ValueError(
            f"{_listed(of_policy)} would have no effect under --use_policy_training_preset=false: set the learning "
            "rate and its schedule with --optimizer.lr and --scheduler.type."
        )
    ignored = [name for name in given if name.startswith(_OPTIMIZER_FLAGS[:2])]
    if ignored and cfg.use_policy_training_preset:
        raise ValueError(
            f"{_listed(ignored)} would have no effect, because the policy chooses its own optimizer and schedule. Set "
            "its learning rate with --policy.lr (--policy.optimizer_lr for LeRobot's policies), or give "
            "--use_policy_training_preset=false with --optimizer.type and --scheduler.type."
        )


def _check_resumed_optimizer(cfg: TrainPipelineConfig, given: Collection[str]) -> None:
    """A resumed run loads its optimizer, learning rate included, from the checkpoint."""
    checkpoint = Path(cfg.checkpoint_path) / PRETRAINED_MODEL_DIR
    saved, now = read_json(checkpoint / TRAIN_CONFIG_NAME), cfg.to_dict()
    ignored = [
        name
        for name in given
        if name.startswith(_OPTIMIZER_FLAGS + _POLICY_OPTIMIZER_FLAGS)
        and name != _CLIPPING
        and _setting(now, name) != _setting(saved, name)
    ]
    if ignored:
        raise ValueError(
            f"{_listed(ignored)} cannot change in a resumed run, which keeps the optimizer and schedule of its "
            f"checkpoint. Leave it out, or start a new run from these weights: --policy.path={checkpoint} without "
            "--config_path and --resume."
        )


def _setting(config: Any, name: str) -> Any:
    for part in name.split("."):
        config = config.get(part) if isinstance(config, dict) else None
    return config


def _listed(names: Collection[str]) -> str:
    return ", ".join(f"--{name}" for name in names)


def check_compiler(device: str) -> None:
    """Check that there is a compiler for `--policy.compile_model`: of C++ on a CPU, of C on a GPU.

    Raises:
        ValueError: There is none.
    """
    variable, usual = ("CXX", ("g++", "clang++")) if device == "cpu" else ("CC", ("gcc", "clang"))
    names = [os.environ[variable]] if variable in os.environ else usual
    if not any(map(shutil.which, names)):
        raise ValueError(
            f"--policy.compile_model=true needs a compiler, and there is no {' or '.join(names)} here: install one (on "
            f"Debian or Ubuntu: apt-get install -y g++), name it in {variable}, or leave the flag out."
        )


def check_login(cfg: TrainPipelineConfig) -> None:
    """Check that Weights & Biases accepts a run that `--wandb.enable=true` asks for; asks for a login in a terminal.

    Raises:
        ValueError: There is no login.
        ImportError: wandb is not installed.
    """
    if not cfg.wandb.enable or not cfg.wandb.project or cfg.wandb.mode in ("offline", "disabled"):
        return
    import wandb

    try:
        wandb.login()
    except wandb.Error as error:
        raise ValueError(
            f"--wandb.enable=true, but there is no login ({error}): log in with `wandb login`, or give "
            "--wandb.mode=offline."
        ) from error


def check_episodes(cfg: TrainPipelineConfig, meta: LeRobotDatasetMetadata) -> None:
    """Check that the dataset has the episodes of `--dataset.episodes`.

    Raises:
        ValueError: It lacks one.
    """
    unknown = sorted(set(cfg.dataset.episodes or ()) - set(range(meta.total_episodes)))
    if unknown:
        raise ValueError(
            f"--dataset.episodes names {unknown[0]}; {meta.repo_id} has the episodes 0 to {meta.total_episodes - 1}."
        )


def write_beside_checkpoint(cfg: TrainPipelineConfig, given: Collection[str]) -> None:
    """Let a resumed run write into the run that its checkpoint is in, which may have been moved.

    Its settings remember the folder that it was started with, which may be relative to another one.

    Args:
        cfg: Its `output_dir` is changed, unless `--output_dir` is given.
        given: Names of the flags on the command line.
    """
    checkpoint = cfg.checkpoint_path
    if not cfg.resume or "output_dir" in given or checkpoint.parent.name != CHECKPOINTS_DIR:
        return
    run = checkpoint.parents[1]
    if run.resolve() != cfg.output_dir.resolve():
        cfg.output_dir = run
