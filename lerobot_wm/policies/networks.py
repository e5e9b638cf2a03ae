"""The settings that a checkpoint's networks were made with: its weights fit no others."""

from copy import deepcopy
from dataclasses import fields, is_dataclass
from functools import reduce
from typing import Any

import torch
from lerobot.configs import PreTrainedConfig
from lerobot.policies import PreTrainedPolicy

# Of every policy: what it reads, where it runs, where it is published.
_OF_ALL_TYPES = {item.name for item in fields(PreTrainedConfig)}


def check_networks(
    policy_class: type[PreTrainedPolicy], config: PreTrainedConfig, saved: PreTrainedConfig
) -> None:
    """Refuse settings that make other networks than a checkpoint has weights for; all others may be changed.

    Which they are is tried: a policy is made with each changed setting.

    Args:
        policy_class: The checkpoint's.
        config: The configuration to act or train with.
        saved: As it is in the checkpoint.

    Raises:
        ValueError: A setting makes parameters more, fewer or of other shapes; names it and both values.
    """
    known, given = _settings(saved), _settings(config)
    changed = [name for name in known.keys() & given.keys() if given[name] != known[name]]
    if not changed:
        return
    shapes = _shapes(policy_class, saved)
    others = [
        f"--policy.{name}={_text(given[name])} (the checkpoint's is {_text(known[name])})"
        for name in sorted(changed)
        if _shapes(policy_class, _with(saved, name, given[name])) != shapes
    ]
    if others:
        raise ValueError(
            f"{', '.join(others)}: other networks than the checkpoint has weights for. Leave the flag out, or train a "
            f"new {saved.type}, --policy.type={saved.type} in place of --policy.path."
        )


def _settings(config: Any, prefix: str = "") -> dict[str, Any]:
    """The settings of a policy type's own, under their flags' dotted names."""
    settings: dict[str, Any] = {}
    for name in (item.name for item in fields(config) if item.name not in _OF_ALL_TYPES):
        value = getattr(config, name)
        settings |= _settings(value, f"{prefix}{name}.") if is_dataclass(value) else {prefix + name: value}
    return settings


def _with(saved: PreTrainedConfig, name: str, value: Any) -> PreTrainedConfig:
    """A configuration with one setting changed."""
    config = deepcopy(saved)
    *path, last = name.split(".")
    setattr(reduce(getattr, path, config), last, value)
    return config


def _shapes(policy_class: type[PreTrainedPolicy], config: PreTrainedConfig) -> dict[str, torch.Size]:
    """Of every parameter and buffer that a policy of this configuration saves."""
    with torch.random.fork_rng(devices=[]):  # a seeded training draws the same numbers after this
        policy = policy_class(deepcopy(config))
    return {name: tensor.shape for name, tensor in policy.state_dict().items()}


def _text(value: Any) -> str:
    """As on a command line."""
    return str(value).lower() if isinstance(value, bool) else str(value)
