"""The peers' environments: one per peer, made from the package registry, none of them shared with the project's."""

import hashlib
import subprocess
import sys
import venv
from importlib.metadata import version
from pathlib import Path

ROOT = Path(__file__).parents[1]
PINS = (
    Path(__file__).parent / "peers"
)  # <peer>.txt: its packages, name==version; torch is added at our version
CACHE = ROOT / "outputs" / "peers"  # ignored by git; can be deleted at any time
OWN = "own"  # the environment that runs the benchmarks


def python_of(environment: str) -> Path:
    """The Python of an environment, which is made on first use and again when its pins change.

    Raises:
        RuntimeError: The packages cannot be installed; says what the installer said.
    """
    if environment == OWN:
        return Path(sys.executable)
    requirements = f"{(PINS / f'{environment}.txt').read_text()}torch=={_torch_version()}\n"
    folder = CACHE / environment
    python = folder / "bin" / "python"
    made_from = folder / "made-from.txt"  # written last: an environment without it is unfinished
    identity = hashlib.sha256(f"{sys.version}\n{requirements}".encode()).hexdigest()
    if not (made_from.is_file() and made_from.read_text() == identity):
        print(f"Making {folder} for the peer {environment}", flush=True)
        _make(folder, python, requirements)
        made_from.write_text(identity)
    return python


def _torch_version() -> str:
    # Without the local part (+cpu, +cu130): an index that has a build for CPUs then serves that.
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
    """The command of a uv that runs: on PATH, or in the Python below this environment; None where there is none."""
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
            f"A peer's environment cannot be made: `{' '.join(command)}` failed.\n{result.stderr[-2000:]}\n"
            "Mend the access to the package registry, or leave the row out (--rows)."
        )
