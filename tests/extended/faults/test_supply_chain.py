"""What others wrote: files that could run code are not read, and packages are bounded, locked and freely licensed."""

import ast
import importlib.metadata
import re
import tomllib
from collections.abc import Iterator
from pathlib import Path

import pytest
from packaging.requirements import Requirement

from lerobot_wm.evaluate.rollouts import EvaluateConfig
from tests.documents import ROOT

MODULES = sorted((ROOT / "lerobot_wm").rglob("*.py"))
# Loading these runs what the file says.
UNSAFE_MODULES = {"pickle", "cPickle", "dill", "cloudpickle", "joblib", "marshal", "shelve", "yaml"}
# Written for Meta-World in memory; and the name of an error.
USED_OF_PICKLE = {
    "envs/simulation.py": {"dumps"},
    "policies/frozen_backbone/modeling_frozen_backbone.py": {"UnpicklingError"},
}

LICENSES = {
    *(
        "0BSD",
        "Apache",
        "Apache 2.0",
        "Apache-2.0",
        "BSD",
        "BSD-2-Clause",
        "BSD-3-Clause",
        "HPND",
        "ISC",
        "MIT",
        "MIT-0",
    ),
    *(
        "MIT-CMU",
        "MPL-2.0",
        "PSF-2.0",
        "Unlicense",
        "Zlib",
        "3-Clause BSD License",
        "Apache Software License",
    ),
    *("BSD License", "ISC License (ISCL)", "MIT License", "Mozilla Public License 2.0 (MPL 2.0)"),
    "Python Software Foundation License",
}
# CUDA's libraries, which PyTorch's Linux wheels need: free of charge, under NVIDIA's own terms.
NVIDIA_LICENSES = {
    "LicenseRef-NVIDIA-Proprietary",
    "Other/Proprietary License",
    "NVIDIA Proprietary Software",
}
# gym-pusht draws with it; only the `environments` extra brings it, and it is linked to, not changed.
LESSER_GPL = {"pygame": "GNU Library or Lesser General Public License (LGPL)"}


def calls(tree: ast.AST) -> Iterator[tuple[str, ast.Call]]:
    """Each call by the dotted name of what is called."""
    for node in ast.walk(tree):
        if isinstance(node, ast.Call):
            yield ast.unparse(node.func), node


def constant(call: ast.Call, name: str) -> object:
    """The value of a keyword argument that is written out."""
    return next(
        (k.value.value for k in call.keywords if k.arg == name and isinstance(k.value, ast.Constant)), None
    )


@pytest.mark.parametrize("path", MODULES, ids=lambda path: str(path.relative_to(ROOT / "lerobot_wm")))
def test_nothing_that_is_read_can_run_code(path: Path) -> None:
    tree = ast.parse(path.read_text())
    name = path.relative_to(ROOT / "lerobot_wm").as_posix()
    imported = {
        alias.name.split(".")[0]
        for node in ast.walk(tree)
        if isinstance(node, ast.Import)
        for alias in node.names
    }
    imported |= {
        str(node.module).split(".")[0] for node in ast.walk(tree) if isinstance(node, ast.ImportFrom)
    }
    assert imported & UNSAFE_MODULES <= ({"pickle"} if name in USED_OF_PICKLE else set())
    used = {
        node.attr
        for node in ast.walk(tree)
        if isinstance(node, ast.Attribute) and isinstance(node.value, ast.Name) and node.value.id == "pickle"
    }
    assert used <= USED_OF_PICKLE.get(name, set())
    for called, call in calls(tree):
        assert called not in ("eval", "exec", "compile", "__import__", "os.system"), called
        if called.endswith("torch.load"):
            assert constant(call, "weights_only") is True, ast.unparse(call)
        assert constant(call, "allow_pickle") is not True, ast.unparse(call)
        assert constant(call, "trust_remote_code") is not True, ast.unparse(call)
        assert constant(call, "shell") is not True, ast.unparse(call)


def test_code_of_a_hub_environment_is_not_trusted_by_default() -> None:
    assert EvaluateConfig.trust_remote_code is False


def test_dependencies_are_bounded_on_both_sides() -> None:
    project = tomllib.loads((ROOT / "pyproject.toml").read_text())["project"]
    extras = [
        text for name, texts in project["optional-dependencies"].items() if name != "dev" for text in texts
    ]
    for requirement in map(Requirement, [*project["dependencies"], *extras]):
        bounds = {specifier.operator for specifier in requirement.specifier}
        assert bounds == {"=="} or bounds == {">=", "<"}, (
            f"{requirement} needs a lowest and a highest version"
        )


def locked_names() -> list[str]:
    return [line.split("==")[0] for line in (ROOT / "requirements.lock").read_text().splitlines()]


def licenses(name: str) -> set[str]:
    """The licences that an installed distribution names: by expression, else by its classifiers, else in words."""
    metadata = importlib.metadata.metadata(name)
    classifiers = [line for line in metadata.get_all("Classifier") or [] if line.startswith("License :: ")]
    text = metadata.get("License-Expression") or ""
    if not text and classifiers:
        return {line.split(" :: ")[-1] for line in classifiers}
    return {
        part for part in re.split(r" AND | OR |[()]", text or metadata.get("License") or "") if part.strip()
    }


@pytest.mark.parametrize("name", locked_names())
def test_locked_packages_are_freely_licensed(name: str) -> None:
    if name == "cuda-toolkit":  # holds no files: it names the CUDA libraries below
        assert not [file for file in importlib.metadata.files(name) or [] if file.suffix in (".py", ".so")]
        return
    found = licenses(name)
    allowed = LICENSES | (NVIDIA_LICENSES if name.startswith("nvidia-") else set()) | {LESSER_GPL.get(name)}
    assert found, f"{name} names no licence"
    assert found <= allowed, f"{name} is licensed under {sorted(found)}"
