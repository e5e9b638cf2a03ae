"""The files of a checkpoint: which of them is missing, damaged or of another release is said in one line."""

import json
from pathlib import Path
from typing import Any

import draccus
from huggingface_hub import hf_hub_download
from huggingface_hub.constants import CONFIG_NAME
from huggingface_hub.errors import EntryNotFoundError, LocalEntryNotFoundError
from lerobot.configs import PreTrainedConfig, parser
from lerobot.utils.constants import POLICY_POSTPROCESSOR_DEFAULT_NAME, POLICY_PREPROCESSOR_DEFAULT_NAME
from safetensors import SafetensorError, safe_open

WHOLE = "copy the checkpoint folder again, whole"  # what mends most of it


def split_revision(checkpoint: str) -> tuple[str, str | None]:
    """Folder or Hub id, and the revision of `user/name@revision`; a folder has none."""
    if "@" not in checkpoint or Path(checkpoint).is_dir():
        return checkpoint, None
    name, _, revision = checkpoint.rpartition("@")
    return name, revision


def checkpoint_file(
    checkpoint: str | Path, name: str, revision: str | None = None, **hub: Any
) -> Path | None:
    """A file of a checkpoint; None where it has no such file.

    Args:
        checkpoint: Folder or Hub id.
        name: Of the file.
        revision: Of the Hub; None takes its main branch.
        **hub: Further options of `hf_hub_download`.

    Raises:
        FileNotFoundError: The folder is behind a link that leads nowhere, or the Hub cannot be reached.
    """
    path = Path(checkpoint) / name
    if Path(checkpoint).is_dir():
        return path if path.is_file() else None
    refuse_broken_link(Path(checkpoint))
    try:
        return Path(hf_hub_download(str(checkpoint), name, revision=revision, **hub))
    except LocalEntryNotFoundError:  # an EntryNotFoundError, too: the Hub was not asked
        raise
    except EntryNotFoundError:
        return None


def refuse_broken_link(path: Path) -> None:
    """Refuse a path through a link that leads nowhere: `checkpoints/last` where the folder it names was removed.

    Raises:
        FileNotFoundError: It is one; names what lies beside the link.
    """
    for link in (path, *path.parents):
        if link.is_symlink() and not link.exists():
            beside = sorted(entry.name for entry in link.parent.iterdir() if entry.is_dir())
            raise FileNotFoundError(
                f"{link} is a link to {link.readlink()}, which is not there; {link.parent} holds "
                f"{', '.join(beside) or 'no other checkpoint'}. Give one that is there, or copy the run again, whole."
            )


def read_json(path: Path) -> Any:
    """The content of a JSON file.

    Raises:
        ValueError: It is none.
    """
    try:
        return json.loads(path.read_text(encoding="utf-8"))
    except (ValueError, RecursionError) as error:
        raise ValueError(f"{path} is no JSON ({error}): it was cut short or damaged; {WHOLE}.") from error


def check_tensors(path: Path) -> None:
    """Refuse a file of tensors that is missing or cut short, or holds a number that is not finite.

    Raises:
        FileNotFoundError: It is missing.
        ValueError: It is damaged, or holds NaN or Inf.
    """
    if not path.is_file():
        raise FileNotFoundError(f"{path} is missing: {WHOLE}.")
    try:
        with safe_open(path, framework="pt") as file:
            bad = [name for name in file.keys() if not file.get_tensor(name).isfinite().all()]  # noqa: SIM118
    except SafetensorError as error:
        raise ValueError(f"{path} cannot be read ({error}): it was cut short or damaged; {WHOLE}.") from error
    if bad:
        raise ValueError(f"{path} {not_finite(bad)}")


def not_finite(names: list[str]) -> str:
    """What is said of a file with NaN or infinite numbers in the tensors of these names."""
    return (
        f"holds NaN or Inf in {', '.join(names[:3])}{' ...' if len(names) > 3 else ''}: the training that wrote it "
        "diverged; take an earlier checkpoint."
    )


def read_config(checkpoint: str | Path, revision: str | None = None, **hub: Any) -> PreTrainedConfig:
    """The configuration of a checkpoint, as LeRobot reads it.

    Args:
        checkpoint: Folder or Hub id.
        revision: Of the Hub; None takes its main branch.
        **hub: Further options of `hf_hub_download`.

    Raises:
        FileNotFoundError: There is none.
        ValueError: It is damaged, of an unknown policy type, or has settings that the type does not know.
    """
    path = checkpoint_file(checkpoint, CONFIG_NAME, revision, **hub)
    if path is None:
        raise FileNotFoundError(
            f"{checkpoint} has no {CONFIG_NAME}: it is no checkpoint, or not a whole one. Give the folder that has it, "
            f"such as RUN/checkpoints/last/pretrained_model, or {WHOLE}."
        )
    content = read_json(path)
    if not isinstance(content, dict) or not isinstance(content.get("type"), str):
        raise ValueError(
            f"{path} names no policy type: it is no policy's configuration, or damaged; {WHOLE}."
        )
    name = content.pop("type")
    types = PreTrainedConfig.get_known_choices()
    if name not in types:
        raise ValueError(
            f"{path} is of policy type {name!r}, which is not registered; known are {', '.join(types)}. Install the "
            "package that defines it, or name it by --policy.discover_packages_path=PACKAGE."
        )
    try:
        return draccus.decode(types[name], content)
    except Exception as error:  # draccus and the types' own checks raise all kinds
        raise ValueError(
            f"{path} is no configuration of a {name} as it is installed here: {error}. It was changed by hand, or a "
            "newer release wrote it: upgrade lerobot and lerobot_policy_wm to the versions that wrote it."
        ) from error


def check_policy_path() -> None:
    """Refuse a checkpoint given by `--policy.path` whose configuration LeRobot's parser would stumble over.

    Raises:
        ValueError, FileNotFoundError: See `read_config`.
    """
    path = parser.get_path_arg("policy")
    if path:
        read_config(path)


def check_processors(checkpoint: str | Path, revision: str | None) -> None:
    """Refuse a checkpoint whose processing steps are not whole, or not LeRobot's registered ones.

    LeRobot imports and calls whatever Python object the files name by its path, such as one that starts programs.

    Args:
        checkpoint: Folder or Hub id.
        revision: Of the Hub; None takes its main branch.

    Raises:
        FileNotFoundError: A file is missing.
        ValueError: A file is damaged, or is no list of registered steps.
    """
    names = [f"{name}.json" for name in (POLICY_PREPROCESSOR_DEFAULT_NAME, POLICY_POSTPROCESSOR_DEFAULT_NAME)]
    paths = [checkpoint_file(checkpoint, name, revision) for name in names]
    states = [step["state_file"] for path in paths if path for step in _steps(path) if "state_file" in step]
    paths += [checkpoint_file(checkpoint, name, revision) for name in states]
    for name, path in zip(names + states, paths, strict=True):
        if path is None:
            raise FileNotFoundError(f"{checkpoint} has no {name}, a part of its processors: {WHOLE}.")
        if name in states:
            check_tensors(path)


def _steps(path: Path) -> list[dict[str, Any]]:
    """The steps that a file lists."""
    try:
        steps = json.loads(path.read_text(encoding="utf-8"))["steps"]
        registered = all(isinstance(step["registry_name"], str) for step in steps)
    except (ValueError, KeyError, TypeError, RecursionError):
        registered = False
    if not registered:
        raise ValueError(
            f"{path} does not name every processing step by its registry_name: it is damaged, or would have a Python "
            "object of its choice called. Use a checkpoint you trust, written by LeRobot."
        )
    return steps
