"""A machine without OpenGL to draw with."""

import os
import subprocess
import sys
from pathlib import Path

import pytest

from tests.extended.faults.running import Inputs

PACKAGES = "apt-get install -y --no-install-recommends libegl1"
# EGL is there, and finds nothing to draw on.
NO_DRIVER = {"__EGL_VENDOR_LIBRARY_FILENAMES": "/nowhere.json"}
COMMAND = (sys.executable, "-m", "lerobot_wm.cli")
# In a mount namespace of its own: the library is there, and holds nothing.
WITHOUT_EGL = """
for file in $(ldconfig -p | grep -o "/.*libEGL.so.*"); do mount --bind /dev/null $(readlink -f $file); done
exec "$@"
"""


def check_refused(
    words: list[str], backend: str, output: Path, fix: str = PACKAGES, **environment: str
) -> None:
    """Run a command in a process that is new: mujoco looks for its backend while it is imported."""
    env = {**os.environ, "MUJOCO_GL": backend, **environment}
    run = subprocess.run(words, env=env, capture_output=True, text=True)
    if "unshare failed" in run.stderr:
        pytest.skip("no library can be hidden here: that takes root")
    assert run.returncode == 1
    assert "Traceback" not in run.stderr
    line = run.stderr.splitlines()[-1]
    assert f"MUJOCO_GL={backend}" in line
    assert fix in line
    assert not list(output.glob("*"))


@pytest.mark.parametrize("fault", ["no library", "no driver", "no such backend", "no such device"])
def test_collect(fault: str, tmp_path: Path) -> None:
    flags = "--tasks=reach-v3 --episodes_per_task=1 --num_workers=1 --repo_id=a/b"
    words = [*COMMAND, "collect", *flags.split(), f"--root={tmp_path / 'output'}"]
    match fault:
        case "no library":
            hidden = ["unshare", "--mount", "bash", "-c", WITHOUT_EGL, "bash", *words]
            check_refused(hidden, "egl", tmp_path / "output")
        case "no driver":
            check_refused(words, "egl", tmp_path / "output", **NO_DRIVER)
        case "no such backend":
            check_refused(words, "bogus", tmp_path / "output", "unset MUJOCO_GL")
        case _:
            fix = "unset MUJOCO_EGL_DEVICE_ID"
            check_refused(words, "egl", tmp_path / "output", fix, MUJOCO_EGL_DEVICE_ID="99")


@pytest.mark.parametrize("workers", [1, pytest.param(2, marks=pytest.mark.slow)])
def test_eval(workers: int, inputs: Inputs, tmp_path: Path) -> None:
    words = [*COMMAND, *inputs.command("eval", tmp_path / "output", workers).split()]
    check_refused(words, "egl", tmp_path / "output" / "videos", **NO_DRIVER)
