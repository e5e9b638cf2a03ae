"""`lerobot-wm doctor`: check this machine; one line per component, `ok` or `fix:` and what to do."""

import argparse
import importlib.metadata
import os
import platform
import shutil
import subprocess
import sys
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path

import torch
from huggingface_hub import get_token
from packaging.requirements import Requirement
from rich.console import Console
from rich.markup import escape
from rich.table import Table
from tqdm import tqdm

from lerobot_wm.constants import ENV_TYPE
from lerobot_wm.errors import cache_folders
from lerobot_wm.files import check_writable
from lerobot_wm.system import cpu_kind, opengl_fix, usable_cores

DISTRIBUTION = "lerobot_policy_wm"
MAIN_PACKAGES = ("lerobot", "torch", "metaworld", "mujoco")
# Packages of mujoco 4.x that install into the same mujoco/ folder and remain after a downgrade.
MUJOCO_LEFTOVERS = ("mujoco-core", "mujoco-studio")
POLICY_TYPES = ("wm_rssm", "frozen_backbone", "wm_bc", "wm_iql", "e2e_bc", "e2e_iql")
# Outputs of a full-size run: dataset, frame cache, latents, checkpoints and videos.
MIN_FREE_GB = 5.0
WIDTH = 100

DISCOVERY = """
from lerobot.configs.policies import PreTrainedConfig
from lerobot.envs.configs import EnvConfig
from lerobot.utils.import_utils import register_third_party_plugins
register_third_party_plugins()
print(*PreTrainedConfig.get_known_choices(), *EnvConfig.get_known_choices())
"""


@dataclass(frozen=True)
class Check:
    """One line of the report.

    Attributes:
        name: What was checked.
        found: What was found.
        fix: What to do; empty if nothing.
        needed: False for components that the pipeline runs without.
    """

    name: str
    found: str
    fix: str = ""
    needed: bool = True

    @property
    def verdict(self) -> str:
        """`ok`, or `fix: ` and what to do."""
        return f"fix: {self.fix}" if self.fix else "ok" if self.needed else "ok (optional)"

    @property
    def is_broken(self) -> bool:
        """Whether the pipeline cannot run because of this."""
        return self.needed and bool(self.fix)


def check_requirement(requirement: Requirement, installed: dict[str, str]) -> Check:
    """Check the installed version of a dependency.

    Args:
        requirement: A dependency in pyproject.toml.
        installed: Version by distribution name (lower case, dashes).
    """
    # With its extras, without its marker.
    wanted = f"{requirement}".split(";")[0].strip()
    version = installed.get(requirement.name)
    if version is None:
        return Check(requirement.name, "not installed", f"pip install '{wanted}'")
    if requirement.specifier.contains(version, prereleases=True):
        return Check(requirement.name, version)
    return Check(requirement.name, f"{version}, expected {requirement.specifier}", f"pip install '{wanted}'")


def check_packages(installed: dict[str, str]) -> list[Check]:
    """Check each main package, all others together, and leftovers of mujoco 4.x.

    Args:
        installed: Version by distribution name (lower case, dashes).
    """
    declared = [Requirement(line) for line in importlib.metadata.requires(DISTRIBUTION) or []]
    # Those of extras have a marker that holds only for the extra.
    needed = [r for r in declared if r.marker is None or r.marker.evaluate({"extra": ""})]
    checks = [check_requirement(r, installed) for r in needed]
    main = [c for c in checks if c.name in MAIN_PACKAGES]
    others = [c for c in checks if c.name not in MAIN_PACKAGES]
    broken = [c for c in others if c.is_broken]
    rest = broken or [Check("other packages", f"{len(others)} within their ranges")]
    leftovers = [name for name in MUJOCO_LEFTOVERS if name in installed]
    if leftovers:
        names = " ".join(leftovers)
        how = f"pip uninstall -y {names}, then pip install --force-reinstall --no-deps 'mujoco<3.17'"
        rest.append(Check("mujoco leftovers", names, how))
    return main + rest


def installed_versions() -> dict[str, str]:
    """Version by installed distribution (lower case, dashes); of several versions, the one that is imported."""
    versions: dict[str, str] = {}
    for found in importlib.metadata.distributions():
        # An interrupted installation has no name.
        if name := found.metadata["Name"]:
            versions.setdefault(name.lower().replace("_", "-"), found.version)
    return versions


def last_words(run: subprocess.CompletedProcess[str]) -> str:
    """The last line that a failed process printed to stderr, or its exit code."""
    lines = run.stderr.strip().splitlines()
    return lines[-1] if lines else f"ended with signal or code {run.returncode}"


def check_rendering() -> Check:
    """Render a frame in another process, because a GL driver may crash it."""
    backend = os.environ.get("MUJOCO_GL", "egl" if sys.platform == "linux" else "")
    probe = Path(__file__).with_name("render_probe.py")
    # -P keeps this folder out of the import path, because its modules are named like common packages.
    run = subprocess.run(
        [sys.executable, "-P", str(probe)],
        env={**os.environ, **({"MUJOCO_GL": backend} if backend else {})},
        capture_output=True,
        text=True,
    )
    name = backend or "default"
    if run.returncode == 0:
        return Check("rendering", f"MUJOCO_GL={name} draws a frame")
    reason = last_words(run)
    return Check("rendering", f"MUJOCO_GL={name} fails: {reason}", opengl_fix(reason))


def check_discovery() -> Check:
    """Check that LeRobot's own commands find our policy types and environment type."""
    run = subprocess.run([sys.executable, "-P", "-c", DISCOVERY], capture_output=True, text=True)
    if run.returncode != 0:
        return Check("LeRobot plug-in", last_words(run), "reinstall: pip install -e . (or the wheel)")
    expected = (*POLICY_TYPES, ENV_TYPE)
    missing = [name for name in expected if name not in run.stdout.split()]
    if missing:
        how = f"install the distribution {DISTRIBUTION} into this environment: pip install -e ."
        return Check("LeRobot plug-in", f"LeRobot does not find {', '.join(missing)}", how)
    return Check("LeRobot plug-in", f"LeRobot finds {', '.join(expected)}")


def check_gpu() -> Check:
    """Report the GPU that PyTorch can use, if any."""
    if torch.cuda.is_available():
        gpu = torch.cuda.get_device_properties(0)
        bf16 = "yes" if torch.cuda.is_bf16_supported(including_emulation=False) else "no"
        found = f"{torch.cuda.device_count()} x {gpu.name}, {gpu.total_memory / 1e9:.0f} GB, bfloat16: {bf16}"
        return Check("GPU", found, needed=False)
    if shutil.which("nvidia-smi"):
        how = f"update the NVIDIA driver to one for CUDA {torch.version.cuda}, or install another torch build"
        return Check(
            "GPU", f"nvidia-smi is here but torch {torch.__version__} sees no GPU", how, needed=False
        )
    return Check("GPU", "none: everything runs on the CPU", needed=False)


def check_folder(name: str, folder: Path, free_gb: float = MIN_FREE_GB) -> Check:
    """Check that files can be written into a folder, and that there is room for them.

    Args:
        name: Name of the check, and the variable that chooses another folder where there is one.
        folder: A folder, which need not exist yet.
        free_gb: Room that is needed there.
    """
    try:
        check_writable(folder)
    except OSError as error:
        fix = f"make {error.filename} writable, or choose another folder"
        return Check(name, f"{folder}: {error.strerror}", fix)
    existing = next(path for path in (folder, *folder.parents) if path.exists())
    free = shutil.disk_usage(existing).free / 1e9
    fix = "" if free >= free_gb else f"free {free_gb:.0f} GB there, or work on another disk"
    return Check(name, f"{free:.1f} GB free at {folder}", fix)


def diagnose() -> list[Check]:
    """Run all checks, in the order in which problems should be fixed."""
    folders = cache_folders()
    if place := os.environ.get("LEROBOT_WM_CACHE"):
        folders["LEROBOT_WM_CACHE"] = Path(place)
    slow: list[Callable[[], Check]] = [check_rendering, check_discovery, check_gpu]
    threads = f"{usable_cores()} cores, {torch.get_num_threads()} PyTorch threads, {cpu_kind()}"
    login = "token found (test it with: hf auth whoami)" if get_token() else "none; to push: hf auth login"
    return [
        Check("Python", f"{platform.python_version()} ({sys.executable})"),
        *check_packages(installed_versions()),
        *[check() for check in tqdm(slow, desc="Checking", unit="check", leave=False)],
        Check("CPU", threads),
        Check("Hub login", login, needed=False),
        check_folder("disk, this folder", Path.cwd()),
        *[check_folder(f"disk, {variable}", folder) for variable, folder in folders.items()],
        check_folder("home folder", Path.home(), free_gb=0),
    ]


def render(checks: list[Check]) -> Table:
    """The checks as a table."""
    table = Table("component", "found", "verdict", title="lerobot-wm doctor")
    for check in checks:
        style = "red" if check.is_broken else "yellow" if check.fix else "green"
        table.add_row(check.name, escape(check.found), f"[{style}]{escape(check.verdict)}[/]")
    return table


def main() -> None:
    """Print the report; exit with 1 if a needed component is broken."""
    argparse.ArgumentParser(prog="lerobot-wm doctor", description=__doc__).parse_args()
    checks = diagnose()
    console = Console()
    console.print(render(checks), width=min(console.width, WIDTH))
    broken = [check.name for check in checks if check.is_broken]
    if broken:
        sys.exit(f"lerobot-wm doctor: fix first: {', '.join(broken)}.")
    console.print("Ready.")
