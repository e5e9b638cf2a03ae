"""Where numbers come from: the command, the versions and the kind of machine."""

import platform
import shlex
import sys
from importlib.metadata import version
from pathlib import Path

import torch

from lerobot_wm.cores import cpu_kind, usable_cores

COMMAND = "command"
PACKAGES = ("lerobot_policy_wm", "lerobot", "torch", "mujoco", "metaworld", "gymnasium", "numpy")


def by_machine(results: list[dict[str, str]]) -> list[tuple[list[str], dict[str, str]]]:
    """The commands of some results with what they share: versions and kind of machine."""
    found: dict[tuple[tuple[str, str], ...], list[str]] = {}
    for facts in results:
        shared = tuple((name, fact) for name, fact in facts.items() if name != COMMAND)
        found.setdefault(shared, []).append(facts[COMMAND])
    return [(commands, dict(shared)) for shared, commands in found.items()]


def provenance() -> dict[str, str]:
    """What produced a result in this process: name -> value."""
    command = f"{Path(sys.argv[0]).name} {shlex.join(sys.argv[1:])}"
    facts = {COMMAND: command, "python": platform.python_version()}
    facts |= {package: version(package) for package in PACKAGES}
    facts["system"] = f"{platform.system()} {platform.machine()}"
    facts["CPU"] = cpu_kind()
    facts["CPU cores"] = str(usable_cores())
    facts["GPU"] = torch.cuda.get_device_name() if torch.cuda.is_available() else "none"
    return facts
