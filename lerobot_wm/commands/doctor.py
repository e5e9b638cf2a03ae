"""`lerobot-wm doctor`: is this machine ready? One line per part, `ok` or `mend: how`."""

import argparse
import importlib.metadata
import os
import shutil
import subprocess
import sys
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path

import torch
from huggingface_hub import constants, get_token
from packaging.requirements import Requirement
from rich.console import Console
from rich.markup import escape
from rich.table import Table
from tqdm import tqdm

from lerobot_wm.constants import ENV_TYPE
from lerobot_wm.system import cpu_kind, usable_cores

DISTRIBUTION = "lerobot_policy_wm"
MAIN_PACKAGES = ("lerobot", "torch", "metaworld", "mujoco")
# Parts of mujoco 4.x that install into the same mujoco/ folder and stay behind after a downgrade.
MUJOCO_LEFTOVERS = ("mujoco-core", "mujoco-studio")
GL_PACKAGES = "libegl1 libopengl0 libgl1-mesa-dri"
POLICY_TYPES = ("wm_rssm", "frozen_backbone", "wm_bc", "wm_iql", "e2e_bc", "e2e_iql")
MIN_FREE_GB = 5.0  # outputs of a full-size run: dataset, frame cache, latents, checkpoints and videos
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
        name: what was looked at.
        found: what is there.
        mend: how to make it right; empty when it is.
        needed: False for parts that the pipeline runs without.
    """

    name: str
    found: str
    mend: str = ""
    needed: bool = True

    @property
    def verdict(self) -> str:
        """`ok`, or `mend: ` and how."""
        return f"mend: {self.mend}" if self.mend else "ok" if self.needed else "ok (optional)"

    @property
    def is_broken(self) -> bool:
        """Whether the pipeline cannot run because of this."""
        return self.needed and bool(self.mend)


def check_python() -> Check:
    """The interpreter's version against the one that pyproject.toml asks for."""
    found = ".".join(map(str, sys.version_info[:3]))
    mend = "" if sys.version_info >= (3, 12) else "make the environment with Python 3.12 or newer"
    return Check("Python", f"{found} ({sys.executable})", mend)


def requirements() -> list[Requirement]:
    """Our distribution's own dependencies, without those of its extras."""
    declared = [Requirement(line) for line in importlib.metadata.requires(DISTRIBUTION) or []]
    return [r for r in declared if r.marker is None or r.marker.evaluate({"extra": ""})]


def check_requirement(requirement: Requirement, installed: dict[str, str]) -> Check:
    """One dependency's installed version against its range.

    Args:
        requirement: a line of pyproject.toml's dependencies.
        installed: version per distribution name (lower case, dashes).
    """
    wanted = f"{requirement}".split(";")[0].strip()  # with its extras
    version = installed.get(requirement.name)
    if version is None:
        return Check(requirement.name, "not installed", f"pip install '{wanted}'")
    if requirement.specifier.contains(version, prereleases=True):
        return Check(requirement.name, version)
    return Check(requirement.name, f"{version}, expected {requirement.specifier}", f"pip install '{wanted}'")


def check_packages(installed: dict[str, str]) -> list[Check]:
    """A line for each main package, one for all others, and one for leftovers of mujoco 4.x.

    Args:
        installed: version per distribution name (lower case, dashes).
    """
    checks = [check_requirement(r, installed) for r in requirements()]
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
    """Version per installed distribution (names in lower case, with dashes), of several the one that is imported."""
    versions: dict[str, str] = {}
    for found in importlib.metadata.distributions():
        if name := found.metadata["Name"]:  # an installation that was broken off has none
            versions.setdefault(name.lower().replace("_", "-"), found.version)
    return versions


def last_words(run: subprocess.CompletedProcess[str]) -> str:
    """Why a process failed: the last line of its errors, or how it ended where it left none."""
    lines = run.stderr.strip().splitlines()
    return lines[-1] if lines else f"ended with signal or code {run.returncode}"


def check_rendering() -> Check:
    """Render a real frame in another process, so that a crash of the GL driver is seen, not suffered."""
    backend = os.environ.get("MUJOCO_GL", "egl" if sys.platform == "linux" else "")
    probe = Path(__file__).with_name("render_probe.py")
    # -P keeps this folder, with modules named as common packages are, off the probe's import path.
    run = subprocess.run(
        [sys.executable, "-P", str(probe)],
        env={**os.environ, **({"MUJOCO_GL": backend} if backend else {})},
        capture_output=True,
        text=True,
    )
    name = backend or "default"
    if run.returncode == 0:
        return Check("rendering", f"MUJOCO_GL={name} draws a frame")
    mend = f"MUJOCO_GL=egl and, on Debian: apt-get install -y --no-install-recommends {GL_PACKAGES}"
    return Check("rendering", f"MUJOCO_GL={name} fails: {last_words(run)}", mend)


def check_discovery() -> Check:
    """Whether a plain `lerobot-train` would find the policy types and the environment type."""
    run = subprocess.run([sys.executable, "-P", "-c", DISCOVERY], capture_output=True, text=True)
    if run.returncode != 0:
        return Check(
            "LeRobot plug-in",
            last_words(run),
            "reinstall: pip install -e . (or the wheel)",
        )
    expected = (*POLICY_TYPES, ENV_TYPE)
    missing = [name for name in expected if name not in run.stdout.split()]
    if missing:
        how = f"install the distribution {DISTRIBUTION} into this environment: pip install -e ."
        return Check("LeRobot plug-in", f"LeRobot does not find {', '.join(missing)}", how)
    return Check("LeRobot plug-in", f"LeRobot finds {', '.join(expected)}")


def check_cpu() -> Check:
    """Cores, threads PyTorch uses and whether the CPU computes bfloat16 natively."""
    return Check("CPU", f"{usable_cores()} cores, {torch.get_num_threads()} PyTorch threads, {cpu_kind()}")


def check_gpu() -> Check:
    """The GPU that PyTorch can use, if any."""
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


def check_disk(name: str, folder: Path) -> Check:
    """Free space where outputs go.

    Args:
        name: the line's name.
        folder: a folder, which need not exist yet.
    """
    existing = next(path for path in (folder, *folder.parents) if path.exists())
    free = shutil.disk_usage(existing).free / 1e9
    mend = "" if free >= MIN_FREE_GB else f"free {MIN_FREE_GB:.0f} GB there, or work on another disk"
    return Check(name, f"{free:.1f} GB free at {folder}", mend)


def check_hub() -> Check:
    """Login to the Hugging Face Hub, needed only to push. Looks for a token, makes no network call."""
    login = "a token is here (hf auth whoami tests it)" if get_token() else "none; to push: hf auth login"
    return Check("Hub login", login, needed=False)


def diagnose() -> list[Check]:
    """Run every check, in the order in which a broken part would be mended."""
    single: list[Callable[[], Check]] = [check_rendering, check_discovery, check_cpu, check_gpu, check_hub]
    return [
        check_python(),
        *check_packages(installed_versions()),
        *[check() for check in tqdm(single, desc="Checking", unit="part", leave=False)],
        check_disk("disk, this folder", Path.cwd()),
        check_disk("disk, HF_HOME", Path(constants.HF_HOME)),
    ]


def render(checks: list[Check]) -> Table:
    """The checks as a table of part, what was found and the verdict."""
    table = Table("part", "found", "verdict", title="lerobot-wm doctor")
    for check in checks:
        style = "red" if check.is_broken else "yellow" if check.mend else "green"
        table.add_row(check.name, escape(check.found), f"[{style}]{escape(check.verdict)}[/]")
    return table


def main() -> None:
    """Print the report; exit with 1 when a needed part is broken."""
    argparse.ArgumentParser(prog="lerobot-wm doctor", description=__doc__).parse_args()
    checks = diagnose()
    console = Console()
    console.print(render(checks), width=min(console.width, WIDTH))
    broken = [check.name for check in checks if check.is_broken]
    if broken:
        sys.exit(f"lerobot-wm doctor: mend first: {', '.join(broken)}.")
    console.print("Ready.")
