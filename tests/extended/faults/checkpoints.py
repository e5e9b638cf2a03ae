"""Small checkpoints, ways to break them, and the line that a command ends with."""

import json
import pickle
import shutil
import sys
from collections.abc import Callable
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch
from accelerate.state import AcceleratorState
from lerobot.configs import PreTrainedConfig
from lerobot.datasets.lerobot_dataset import LeRobotDataset
from lerobot.policies import get_policy_class
from safetensors.torch import load_file, save_file
from torch import Tensor

from lerobot_wm import cli
from lerobot_wm.commands.init import InitConfig, initialise
from lerobot_wm.data.source import SourceConfig
from lerobot_wm.world_model.config import RSSMConfig
from tests.extended.faults.breakage import Fault, cut, remove, set_entry, write
from tests.recording import camera, record, vector

CONFIG, WEIGHTS = "config.json", "model.safetensors"
PREPROCESSOR, POSTPROCESSOR = "policy_preprocessor.json", "policy_postprocessor.json"
STATISTICS = "policy_preprocessor_step_3_normalizer_processor.safetensors"

TASKS = ("Reach a goal position", "Push and close a window")
FEATURES = {
    "observation.image": camera(64, 64),
    "observation.state": vector(4),
    "action": vector(4),
    "next.reward": vector(1),
    "next.done": vector(1, "bool"),
}


def rewards(t: int, length: int) -> dict[str, Any]:
    """A reward at the end."""
    return {"next.reward": np.float32([t == length - 1]), "next.done": np.array([t == length - 1])}


def record_demos(root: Path, **changes: Any) -> LeRobotDataset:
    """Two short episodes as in Meta-World, one of each task; features given here are changed, or left out with None."""
    features = {key: feature for key, feature in {**FEATURES, **changes}.items() if feature is not None}
    labels = rewards if "next.reward" in features else lambda t, length: {}
    return record(root, features, [(TASKS[0], 5), (TASKS[1], 6)], labels)


def make_checkpoint(
    policy_type: str,
    root: Path,
    dataset: LeRobotDataset,
    *,
    seed: int = 0,
    use_proprio: bool = False,
    **settings: Any,
) -> Path:
    """An untrained policy's checkpoint."""
    make = PreTrainedConfig.get_choice_class(policy_type)
    small = {"rssm": RSSMConfig(16, 8, 16, 16, use_proprio=use_proprio)} if policy_type == "wm_rssm" else {}
    small |= {"hidden_dims": [8]} if policy_type.endswith(("bc", "iql")) else {}
    config = make(device="cpu", push_to_hub=False, **small, **settings)
    return initialise(InitConfig(config, SourceConfig(dataset.repo_id, str(dataset.root)), root, seed))


def load(checkpoint: Path, policy_type: str) -> Any:
    """A checkpoint, as Python loads it."""
    return get_policy_class(policy_type).from_pretrained(checkpoint)


def change_tensors(root: Path, name: str, change: Callable[[dict[str, Tensor]], object]) -> None:
    """Change a safetensors file."""
    tensors = load_file(root / name)
    change(tensors)
    save_file(tensors, root / name)


def a_matrix(tensors: dict[str, Tensor]) -> str:
    """The name of some weight."""
    return next(name for name, tensor in tensors.items() if tensor.ndim >= 2)


def drop(tensors: dict[str, Tensor]) -> None:
    del tensors[a_matrix(tensors)]


def add(tensors: dict[str, Tensor]) -> None:
    tensors["surprise"] = torch.zeros(1)


def widen(tensors: dict[str, Tensor]) -> None:
    name = a_matrix(tensors)
    tensors[name] = torch.zeros(tensors[name].shape[0] + 1, *tensors[name].shape[1:])


def spoil(tensors: dict[str, Tensor]) -> None:
    tensors[a_matrix(tensors)].view(-1)[0] = torch.nan


class Canary:
    """Unpickled, it makes a file."""

    def __init__(self, path: Path) -> None:
        self.path = path

    def __reduce__(self) -> tuple[Any, ...]:
        return Path.touch, (self.path,)


def plant_pickles(folder: Path, canary: Path) -> None:
    """Put pickles beside a checkpoint's files, under the names that PyTorch's tools give theirs."""
    for name in (
        "pytorch_model.bin",
        "model.pt",
        "model.pkl",
        "optimizer.pt",
        "optimizer.bin",
        "scheduler.pt",
    ):
        (folder / name).write_bytes(pickle.dumps(Canary(canary)))


# What is wrong -> (how it came about, what the message says after the name of the folder).
WEIGHT_FAULTS: dict[str, tuple[Fault, str]] = {
    "a weight missing": (partial(change_tensors, name=WEIGHTS, change=drop), f"/{WEIGHTS} does not fit"),
    "a weight too many": (partial(change_tensors, name=WEIGHTS, change=add), f"/{WEIGHTS} does not fit"),
    "a weight of another shape": (
        partial(change_tensors, name=WEIGHTS, change=widen),
        f"/{WEIGHTS} does not fit",
    ),
    "NaN in a weight": (
        partial(change_tensors, name=WEIGHTS, change=spoil),
        f"/{WEIGHTS} holds NaN or Inf in ",
    ),
    "weights cut short": (partial(cut, name=WEIGHTS), f"/{WEIGHTS} cannot be read"),
    "weights empty": (partial(write, name=WEIGHTS, text=""), f"/{WEIGHTS} cannot be read"),
    "weights missing": (partial(remove, name=WEIGHTS), f"/{WEIGHTS} is missing"),
}
CONFIG_FAULTS: dict[str, tuple[Fault, str]] = {
    "no configuration": (partial(remove, name=CONFIG), f" has no {CONFIG}"),
    "configuration cut short": (partial(cut, name=CONFIG), f"/{CONFIG} is not JSON"),
    "configuration without a type": (
        partial(write, name=CONFIG, text="[]"),
        f"/{CONFIG} names no policy type",
    ),
    "a setting of a newer release": (
        partial(set_entry, name=CONFIG, keys=["horizon_of_2030"], value=3),
        f"/{CONFIG} is not a configuration of the ",
    ),
    "a type of a newer release": (
        partial(set_entry, name=CONFIG, keys=["type"], value="wm_2030"),
        f"/{CONFIG} is of policy type 'wm_2030'",
    ),
    "the type of another policy": (
        partial(set_entry, name=CONFIG, keys=["type"], value="act"),
        f"/{CONFIG} is not a configuration of the act",
    ),
}
PROCESSOR_FAULTS: dict[str, tuple[Fault, str]] = {
    "no preprocessor": (partial(remove, name=PREPROCESSOR), f" has no {PREPROCESSOR}"),
    "no postprocessor": (partial(remove, name=POSTPROCESSOR), f" has no {POSTPROCESSOR}"),
    "preprocessor cut short": (
        partial(cut, name=PREPROCESSOR),
        f"/{PREPROCESSOR} does not give a registry_name",
    ),
    "statistics missing": (partial(remove, name=STATISTICS), f" has no {STATISTICS}"),
    "statistics cut short": (partial(cut, name=STATISTICS), f"/{STATISTICS} cannot be read"),
}


def last_line(*arguments: str) -> str:
    """The one line that `lerobot-wm ARGUMENTS` ends with; arguments may hold several flags separated by spaces."""
    before = sys.argv
    sys.argv = ["lerobot-wm", *" ".join(arguments).split()]
    try:
        with pytest.raises(SystemExit) as end:
            cli.main()
    finally:
        sys.argv = before
        AcceleratorState._reset_state(True)
    line = str(end.value)
    assert line.startswith(f"lerobot-wm {arguments[0].split()[0]}: ")
    assert "\n" not in line
    return line


def broken_copy(checkpoint: Path, folder: Path, break_it: Fault) -> Path:
    """A copy of a checkpoint, broken."""
    copy = shutil.copytree(checkpoint, folder)
    break_it(copy)
    return copy


def set_type(checkpoint: Path, name: str) -> None:
    """Have the configuration name another type."""
    content = json.loads((checkpoint / CONFIG).read_text())
    (checkpoint / CONFIG).write_text(json.dumps(content | {"type": name}))
