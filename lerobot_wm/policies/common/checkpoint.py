"""The files of a checkpoint, and the gate through which commands open one."""

import json
from pathlib import Path
from typing import Any

import draccus
from huggingface_hub import hf_hub_download
from huggingface_hub.constants import CONFIG_NAME, SAFETENSORS_SINGLE_FILE
from huggingface_hub.errors import EntryNotFoundError, LocalEntryNotFoundError
from lerobot.configs import PreTrainedConfig
from lerobot.utils.constants import POLICY_POSTPROCESSOR_DEFAULT_NAME, POLICY_PREPROCESSOR_DEFAULT_NAME
from safetensors import SafetensorError, safe_open

WHOLE = "copy the complete checkpoint folder again"  # fixes most damaged checkpoints


class CheckpointError(ValueError):
    """A checkpoint is damaged, of another type or release, or does not fit its configuration."""


def open_checkpoint(
    checkpoint: str | Path, revision: str | None = None, *, with_processors: bool = True
) -> PreTrainedConfig:
    """Read a checkpoint's configuration and check that its files are there and whole, before any work is done.

    Args:
        checkpoint: Folder, Hub id, or user/name@revision.
        revision: On the Hub; None takes that of the name, or the main branch.
        with_processors: Whether its processors are needed; a world model is read without.

    Raises:
        FileNotFoundError: A file is missing.
        CheckpointError: A file is damaged, the policy type or a setting is unknown here, or a processor is not one of
            LeRobot's registered steps: LeRobot would import and call any Python object it names.
    """
    name, named_revision = split_revision(str(checkpoint))
    revision = revision or named_revision
    config = read_config(name, revision)
    if not config.use_peft:
        weights = checkpoint_file(name, SAFETENSORS_SINGLE_FILE, revision)
        if weights is None:
            raise FileNotFoundError(f"{name}/{SAFETENSORS_SINGLE_FILE} is missing: {WHOLE}.")
        try:
            with safe_open(weights, framework="pt"):
                pass
        except SafetensorError as error:
            raise cut_short(weights, error) from error
    if with_processors:
        _check_processors(name, revision)
    return config


def split_revision(checkpoint: str) -> tuple[str, str | None]:
    """Folder or Hub id, and the revision of `user/name@revision`; a folder has none."""
    if "@" not in checkpoint or Path(checkpoint).is_dir():
        return checkpoint, None
    name, _, revision = checkpoint.rpartition("@")
    return name, revision


def checkpoint_file(
    checkpoint: str | Path, name: str, revision: str | None = None, **hub: Any
) -> Path | None:
    """A file of a checkpoint; None where there is no such file.

    Args:
        checkpoint: Folder or Hub id.
        name: The file's name.
        revision: On the Hub; None takes the main branch.
        **hub: Further options of `hf_hub_download`.

    Raises:
        FileNotFoundError: The folder is behind a broken link, or the Hub cannot be reached.
    """
    path = Path(checkpoint) / name
    if Path(checkpoint).is_dir():
        return path if path.is_file() else None
    _check_links(Path(checkpoint))
    try:
        return Path(hf_hub_download(str(checkpoint), name, revision=revision, **hub))
    except LocalEntryNotFoundError:  # an EntryNotFoundError too, but here the Hub was not asked
        raise
    except EntryNotFoundError:
        return None


def _check_links(path: Path) -> None:
    """Refuse a path through a broken link, such as `checkpoints/last` after its folder was removed."""
    for link in (path, *path.parents):
        if link.is_symlink() and not link.exists():
            beside = sorted(entry.name for entry in link.parent.iterdir() if entry.is_dir())
            raise FileNotFoundError(
                f"{link} is a link to {link.readlink()}, which does not exist; {link.parent} holds "
                f"{', '.join(beside) or 'no other checkpoint'}. Give an existing one, or copy the complete run again."
            )


def read_json(path: Path) -> Any:
    """The content of a JSON file.

    Raises:
        CheckpointError: It is not JSON.
    """
    try:
        return json.loads(path.read_text(encoding="utf-8"))
    except (ValueError, RecursionError) as error:
        raise CheckpointError(
            f"{path} is not JSON ({error}): it was cut short or damaged; {WHOLE}."
        ) from error


def check_tensors(path: Path) -> None:
    """Check that a file of tensors is there and whole, with finite numbers only.

    Raises:
        FileNotFoundError: It is missing.
        CheckpointError: It is damaged, or holds NaN or Inf.
    """
    if not path.is_file():
        raise FileNotFoundError(f"{path} is missing: {WHOLE}.")
    try:
        with safe_open(path, framework="pt") as file:
            bad = [name for name in file.keys() if not file.get_tensor(name).isfinite().all()]  # noqa: SIM118
    except SafetensorError as error:
        raise cut_short(path, error) from error
    if bad:
        raise not_finite(path, bad)


def cut_short(path: Path, error: Exception) -> CheckpointError:
    """The error for a file of tensors that cannot be read."""
    return CheckpointError(f"{path} cannot be read ({error}): it was cut short or damaged; {WHOLE}.")


def not_finite(path: Path, names: list[str]) -> CheckpointError:
    """The error for a file with NaN or infinite numbers in the tensors of these names."""
    return CheckpointError(
        f"{path} holds NaN or Inf in {', '.join(names[:3])}{' ...' if len(names) > 3 else ''}: the run that wrote it "
        "diverged. Use an earlier checkpoint."
    )


def read_config(checkpoint: str | Path, revision: str | None = None, **hub: Any) -> PreTrainedConfig:
    """The configuration of a checkpoint, as LeRobot reads it.

    Args:
        checkpoint: Folder or Hub id.
        revision: On the Hub; None takes the main branch.
        **hub: Further options of `hf_hub_download`.

    Raises:
        FileNotFoundError: There is none.
        CheckpointError: It is damaged, of an unknown policy type, or has settings that the type does not know.
    """
    path = checkpoint_file(checkpoint, CONFIG_NAME, revision, **hub)
    if path is None:
        raise FileNotFoundError(
            f"{checkpoint} has no {CONFIG_NAME}: it is not a checkpoint, or not a complete one. Give the folder "
            f"that has it, such as RUN/checkpoints/last/pretrained_model, or {WHOLE}."
        )
    content = read_json(path)
    if not isinstance(content, dict) or not isinstance(content.get("type"), str):
        raise CheckpointError(
            f"{path} names no policy type: it is not a policy's configuration, or damaged; {WHOLE}."
        )
    name = content.pop("type")
    types = PreTrainedConfig.get_known_choices()
    if name not in types:
        raise CheckpointError(
            f"{path} is of policy type {name!r}, which is not registered; known are {', '.join(types)}. Install the "
            "package that defines it, or name it with --policy.discover_packages_path=PACKAGE."
        )
    try:
        return draccus.decode(types[name], content)
    except Exception as error:  # draccus and the types' own checks raise all kinds
        raise CheckpointError(
            f"{path} is not a configuration of the {name} installed here: {error}. It was edited, or another release "
            "wrote it: install the versions of lerobot and lerobot_policy_wm that wrote it."
        ) from error


def _check_processors(checkpoint: str, revision: str | None) -> None:
    """Check that the processing steps are whole, and LeRobot's registered ones."""
    names = [f"{name}.json" for name in (POLICY_PREPROCESSOR_DEFAULT_NAME, POLICY_POSTPROCESSOR_DEFAULT_NAME)]
    paths = [checkpoint_file(checkpoint, name, revision) for name in names]
    states = [step["state_file"] for path in paths if path for step in _steps(path) if "state_file" in step]
    paths += [checkpoint_file(checkpoint, name, revision) for name in states]
    for name, path in zip(names + states, paths, strict=True):
        if path is None:
            raise FileNotFoundError(f"{checkpoint} has no {name}, which is part of its processors: {WHOLE}.")
        if name in states:
            check_tensors(path)


def _steps(path: Path) -> list[dict[str, Any]]:
    """The processing steps that a file lists."""
    try:
        steps = json.loads(path.read_text(encoding="utf-8"))["steps"]
        registered = all(isinstance(step["registry_name"], str) for step in steps)
    except (ValueError, KeyError, TypeError, RecursionError):
        registered = False
    if not registered:
        raise CheckpointError(
            f"{path} does not give a registry_name for every processing step: it is damaged, or would call a Python "
            "object of its choice. Use a checkpoint you trust, written by LeRobot."
        )
    return steps
