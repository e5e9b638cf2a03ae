"""One Python environment for each peer, made from the package registry and separate from the project's."""

import hashlib
import subprocess
import sys
import venv
from importlib.metadata import version
from pathlib import Path

ROOT = Path(__file__).parents[1]
# <peer>.txt lists the peer's packages as name==version; our version of torch is added.
PINS = Path(__file__).parent / "peers"
CACHE = ROOT / "outputs" / "peers"  # ignored by git; can be deleted
OWN = "own"  # the environment that runs the benchmarks


def python_of(environment: str) -> Path:
    """Return the Python of an environment, which is created on first use and again when its pins change.

    Raises:
        RuntimeError: The packages cannot be installed. Contains the installer's message.
    """
    if environment == OWN:
        return Path(sys.executable)
    requirements = f"{(PINS / f'{environment}.txt').read_text()}torch=={_torch_version()}\n"
    folder = CACHE / environment
    python = folder / "bin" / "python"
    made_from = folder / "made-from.txt"  # written last; an environment without it is incomplete
    identity = hashlib.sha256(f"{sys.version}\n{requirements}".encode()).hexdigest()
    if not (made_from.is_file() and made_from.read_text() == identity):
        print(f"Creating {folder} for the peer {environment}", flush=True)
        _make(folder, python, requirements)
        made_from.write_text(identity)
    return python


def _torch_version() -> str:
    # Without the local part (+cpu, +cu130), which package indexes do not know.
    return version("torch").split("+")[0]


def _make(folder: Path, python: Path, requirements: str) -> None:
    folder.mkdir(parents=True, exist_ok=True)
    pins = folder / "requirements.txt"
    uv = _uv()
    if uv is None:
        venv.create(folder, clear=True, with_pip=True)
        install = [str(python), "-m", "pip", "install"]
    else:
        _run([*uv, "venv", "--clear", "--python", sys.executable, str(folder)])
        install = [*uv, "pip", "install", "--python", str(python)]
    pins.write_text(requirements)
    _run([*install, "--requirement", str(pins)])


def _uv() -> list[str] | None:
    """Return the command of a working uv, from PATH or from the base Python; None if there is none."""
    for command in (["uv"], [str(Path(sys.base_prefix) / "bin" / "python3"), "-m", "uv"]):
        try:
            subprocess.run([*command, "--version"], check=True, capture_output=True)
        except (OSError, subprocess.CalledProcessError):
            continue
        return command
    return None


def _run(command: list[str]) -> None:
    result = subprocess.run(command, capture_output=True, text=True)
    if result.returncode != 0:
        raise RuntimeError(
            f"Cannot create a peer's environment: `{' '.join(command)}` failed.\n{result.stderr[-2000:]}\n"
            "Check the access to the package registry, or leave out the row with --rows."
        )
