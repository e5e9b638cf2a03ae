"""`lerobot-wm doctor`: what it says of this machine, and of broken ones."""

import io
import os
import subprocess
import sys
from pathlib import Path

import pytest
from packaging.requirements import Requirement
from rich.console import Console

from lerobot_wm.commands import doctor


def test_command_reports_every_part_and_fits_the_terminal(tmp_path: Path) -> None:
    environment = {**os.environ, "COLUMNS": "100", "MUJOCO_GL": "egl", "HF_HOME": str(tmp_path)}
    command = [str(Path(sys.executable).with_name("lerobot-wm")), "doctor"]
    run = subprocess.run(command, env=environment, capture_output=True, text=True)
    assert run.returncode == 0, run.stdout + run.stderr
    assert max(map(len, run.stdout.splitlines())) <= 100
    for part in ("Python", "mujoco", "rendering", "LeRobot plug-in", "CPU", "GPU", "Hub login", "disk"):
        assert part in run.stdout
    assert "fix:" not in run.stdout
    assert "none; to push: hf auth login" in run.stdout


def test_a_gl_backend_that_cannot_render_is_reported(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("MUJOCO_GL", "no_such_backend")
    check = doctor.check_rendering()
    assert check.is_broken
    assert "no_such_backend" in check.found
    assert "unset MUJOCO_GL" in check.verdict


@pytest.mark.parametrize("version", ["3.17.0", "4.0.0"])
def test_mujoco_that_breaks_metaworld_is_reported(version: str) -> None:
    installed = {**doctor.installed_versions(), "mujoco": version}
    [broken] = [check for check in doctor.check_packages(installed) if check.is_broken]
    assert broken.name == "mujoco"
    assert version in broken.found
    assert "<3.17" in broken.fix


def test_leftovers_of_mujoco_4_are_reported() -> None:
    installed = {**doctor.installed_versions(), "mujoco-core": "4.0.0"}
    [broken] = [check for check in doctor.check_packages(installed) if check.is_broken]
    assert broken.found == "mujoco-core"
    assert "pip uninstall -y mujoco-core" in broken.fix


def test_missing_package_is_reported() -> None:
    check = doctor.check_requirement(Requirement("metaworld==3.0.0"), {})
    assert check.verdict == "fix: pip install 'metaworld==3.0.0'"


def test_advice_keeps_the_extras_and_is_shown_whole() -> None:
    check = doctor.check_requirement(Requirement("lerobot[training,dataset]>=0.6.1,<0.7"), {})
    assert check.fix == "pip install 'lerobot[dataset,training]<0.7,>=0.6.1'"
    console = Console(width=100, record=True, file=io.StringIO())
    console.print(doctor.render([check]))
    assert "lerobot[dataset,training]" in console.export_text()


def test_a_discovery_that_dies_without_a_word_is_reported(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(doctor, "DISCOVERY", "import os, signal; os.kill(os.getpid(), signal.SIGKILL)")
    check = doctor.check_discovery()
    assert check.is_broken
    assert check.found == "ended with signal or code -9"


def test_full_disk_is_reported(tmp_path: Path) -> None:
    assert doctor.check_folder("disk", tmp_path / "not" / "there", free_gb=1e9).is_broken


def test_optional_parts_never_fail_the_command() -> None:
    check = doctor.Check("GPU", "driver too old", "update it", needed=False)
    assert check.verdict == "fix: update it"
    assert not check.is_broken


def test_of_two_installations_the_imported_one_counts(
    monkeypatch: pytest.MonkeyPatch, tmp_path: Path
) -> None:
    """As in an environment on top of the system's packages, one of which an interrupted pip left without a name."""
    for folder, version in (("own", "2.0"), ("system", "1.0")):
        made = tmp_path / folder / f"something-{version}.dist-info"
        made.mkdir(parents=True)
        (made / "METADATA").write_text(f"Metadata-Version: 2.1\nName: something\nVersion: {version}\n")
        monkeypatch.syspath_prepend(tmp_path / folder) if folder == "system" else None
    (tmp_path / "system" / "broken-1.0.dist-info").mkdir()
    monkeypatch.syspath_prepend(tmp_path / "own")
    assert doctor.installed_versions()["something"] == "2.0"
