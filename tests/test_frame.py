"""The frame of the project: who may import whom, how LeRobot finds it, what it installs with."""

import ast
import importlib.metadata
import subprocess
import sys
import tomllib
import zipfile
from collections.abc import Iterable, Iterator
from graphlib import TopologicalSorter
from pathlib import Path

import pytest
from hatchling.builders.wheel import WheelBuilder
from packaging.requirements import Requirement
from packaging.version import Version

ROOT = Path(__file__).parents[1]
PACKAGE = ROOT / "lerobot_wm"

# A part imports only parts of a lower level; parts of one level do not import each other.
LEVELS = {
    name: level
    for level, names in enumerate(
        (
            ("constants", "files", "errors", "system", "markdown"),
            ("records", "workers", "nn"),
            ("tables", "world_model", "rl"),
            ("data", "envs"),
            ("policies",),
            ("collect", "encode", "evaluate"),
            ("train",),
            ("inspect",),
            ("report",),
            ("commands",),
            ("experiment",),
            ("cli",),
        )
    )
    for name in names
}
# Usable in any torch program: these know neither LeRobot nor a simulator.
TORCH_ONLY = ("nn", "world_model", "rl")
FOREIGN_TO_TORCH_ONLY = {"lerobot", "gymnasium", "metaworld", "mujoco"}

DISCOVERY = """
import sys
from lerobot.configs.policies import PreTrainedConfig
from lerobot.envs.configs import EnvConfig
from lerobot.utils.import_utils import register_third_party_plugins
register_third_party_plugins()
print("types", *PreTrainedConfig.get_known_choices(), *EnvConfig.get_known_choices())
print("modules", *sys.modules)
"""


def imports(path: Path) -> Iterator[str]:
    """Dotted names of all that a file imports, inside functions too; `from a import b` gives `a.b`."""
    for node in ast.walk(ast.parse(path.read_text())):
        if isinstance(node, ast.Import):
            yield from (alias.name for alias in node.names)
        elif isinstance(node, ast.ImportFrom):
            assert node.level == 0, f"{path}: relative import, expected 'from lerobot_wm...'"
            yield from (f"{node.module}.{alias.name}" for alias in node.names)


def part_of(path: Path) -> str:
    return path.relative_to(PACKAGE).with_suffix("").parts[0]


# The package's own __init__ imports configurations of several levels to register them.
MODULES = sorted(path for path in PACKAGE.rglob("*.py") if path != PACKAGE / "__init__.py")


def test_every_part_has_a_level() -> None:
    assert {part_of(path) for path in MODULES} == set(LEVELS)


@pytest.mark.parametrize("path", MODULES, ids=lambda path: str(path.relative_to(PACKAGE)))
def test_imports_go_downwards(path: Path) -> None:
    part = part_of(path)
    ours = {name.split(".")[1] for name in imports(path) if name.startswith("lerobot_wm.")}
    upwards = {other for other in ours - {part} if LEVELS.get(other, 0) >= LEVELS[part]}
    assert not upwards, f"{part} (level {LEVELS[part]}) imports {upwards}"
    if part in TORCH_ONLY:
        assert not FOREIGN_TO_TORCH_ONLY & {name.split(".")[0] for name in imports(path)}


def test_imports_make_no_circle() -> None:
    """Imports inside functions and behind TYPE_CHECKING count too."""
    names = {".".join(path.relative_to(ROOT).with_suffix("").parts): path for path in MODULES}
    graph = {name: {_module(imported, names) for imported in imports(path)} for name, path in names.items()}
    list(TopologicalSorter(graph).static_order())  # raises CycleError with the modules of a circle


def _module(imported: str, names: Iterable[str]) -> str:
    """The module that a dotted name is of: itself, or the one that defines it."""
    return imported if imported in names else imported.rpartition(".")[0]


def test_lerobot_discovers_types_and_imports_no_more_than_configurations(tmp_path: Path) -> None:
    # From another folder, so that only the installed distribution can be found.
    run = subprocess.run(
        [sys.executable, "-c", DISCOVERY], cwd=tmp_path, capture_output=True, text=True, check=True
    )
    lines = {line.split()[0]: set(line.split()[1:]) for line in run.stdout.splitlines()}
    ours = {"wm_rssm", "frozen_backbone", "wm_bc", "wm_iql", "e2e_bc", "e2e_iql", "metaworld_mt"}
    assert ours <= lines["types"]
    assert "lerobot_policy_wm" in lines["modules"]
    assert not {"mujoco", "metaworld"} & lines["modules"]
    assert not [name for name in lines["modules"] if name.startswith("lerobot_wm.") and ".modeling_" in name]


def locked() -> dict[str, Version]:
    lines = (ROOT / "requirements.lock").read_text().splitlines()
    pairs = [line.split("==") for line in lines]
    assert all(len(pair) == 2 for pair in pairs), "expected only lines name==version"
    assert len({name for name, _ in pairs}) == len(pairs), "a package is listed twice"
    return {name: Version(version) for name, version in pairs}


def test_lock_satisfies_pyproject() -> None:
    project = tomllib.loads((ROOT / "pyproject.toml").read_text())
    declared = [
        *project["build-system"]["requires"],
        *project["project"]["dependencies"],
        *project["project"]["optional-dependencies"]["environments"],
        *project["project"]["optional-dependencies"]["dev"],
    ]
    versions = locked()
    for requirement in map(Requirement, declared):
        assert requirement.specifier.contains(versions[requirement.name]), requirement


def test_lock_leaves_torchcodec_out() -> None:
    # On a machine without FFmpeg's libraries LeRobot prints its loading errors, some hundred lines, at each start.
    # Without it LeRobot decodes with PyAV, which brings its own.
    assert "torchcodec" not in locked()


# Requirements that the lock does not meet, and why it works nevertheless.
UNMET = {
    ("gym-pusht", "opencv-python"): "the headless one, which is locked, is the same package without windows",
    (
        "gym-aloha",
        "mujoco",
    ): "asks for <3.9 as an older dm-control does; runs with the locked ones (its test shows it)",
    ("dm-control", "labmaze"): "of its mazes, not imported here; has no wheel for Python 3.13",
}


def test_locked_packages_agree_with_each_other() -> None:
    """Every requirement of every locked package is in the lock, at a version it accepts; but for the known."""
    versions = locked()
    unmet = set()
    for name in versions:
        for requirement in map(Requirement, importlib.metadata.requires(name) or []):
            if requirement.marker is None or requirement.marker.evaluate({"extra": ""}):
                key = requirement.name.lower().replace("_", "-").replace(".", "-")
                if key not in versions or not requirement.specifier.contains(versions[key], prereleases=True):
                    unmet.add((name, key))
    assert unmet == set(UNMET)


def test_wheel_holds_modules_data_and_license(tmp_path: Path) -> None:
    [wheel] = WheelBuilder(str(ROOT)).build(directory=str(tmp_path), versions=["standard"])
    names = set(zipfile.ZipFile(wheel).namelist())
    ours = (path for path in PACKAGE.rglob("*") if path.is_file() and "__pycache__" not in path.parts)
    assert {str(path.relative_to(ROOT)) for path in ours} | {"lerobot_policy_wm.py"} <= names
    assert any(name.endswith("licenses/LICENSE") for name in names)
    assert not [name for name in names if name.startswith(("tests", "scripts", "outputs"))]
