"""Errors a user can act on become one line instead of a traceback."""

import errno
import os
import sys
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from traceback import clear_frames, walk_tb

import httpx
from huggingface_hub import constants, whoami
from huggingface_hub.errors import (
    HfHubHTTPError,
    HFValidationError,
    LocalTokenNotFoundError,
    OfflineModeIsEnabled,
)

INTERRUPTED = 130  # exit code after Ctrl-C: 128 plus the signal's number
_READING = ("GET", "HEAD")  # requests that change nothing on the Hub
LOGIN = "log in with `hf auth login`, or set HF_TOKEN"
_OURS = "lerobot_wm"
# Errors of the disk, which libraries often repeat in their own exceptions -> how to fix them.
_DISK = {
    errno.ENOSPC: "make room there, or choose another place",
    errno.EDQUOT: "make room there, or choose another place",
    errno.EROFS: "make it writable, or choose another place",
}
# Errors that the operating system reports together with a file name.
_FILE = {
    **_DISK,
    errno.EACCES: "make it accessible, or choose another place",
    errno.EPERM: "make it accessible, or choose another place",
    errno.EEXIST: "remove it, or choose another place",
    errno.ENOTDIR: "a file is where a folder should be",
}
_PARSERS = ("draccus", "lerobot.configs.policies", "lerobot.configs.train")


class HubRefusalError(RuntimeError):
    """The Hub would refuse this command; found before any work is done."""


class WorkerError(RuntimeError):
    """The one-line error of a worker process."""


@contextmanager
def exit_with_one_line(command: str) -> Iterator[None]:
    """End the program with one line for errors that tell the user what to do; others keep their traceback.

    These are: Ctrl-C, full or read-only disks, refusals of the Hub, unreadable flags and configurations, and each
    ValueError, OSError and RuntimeError that is raised in this package rather than in a library.

    Args:
        command: The command's name, with which the line starts.
    """
    try:
        yield
    except KeyboardInterrupt as stop:
        _close_progress_bars(stop)
        hint = str(stop) or "run the same command again; it resumes or starts over"
        print(f"\n{command}: interrupted; {hint}.", file=sys.stderr)
        raise SystemExit(INTERRUPTED) from None
    except Exception as error:
        line = line_for(error)
        if line is None:
            raise
        _close_progress_bars(error)
        raise SystemExit(f"{command}: {line}") from error


def _close_progress_bars(error: BaseException | None) -> None:
    """Drop the frames that an error passed through, so that progress bars in them finish printing before our line."""
    while error is not None:
        clear_frames(error.__traceback__)
        error = error.__context__


def disk_problem(error: BaseException) -> str | None:
    """What the disk refused and how to fix it; None for other errors and for those raised in this package.

    Libraries repeat the system's message, but not always its error number.
    """
    if isinstance(error, OSError) and error.filename and error.errno in _FILE:
        return (
            f"{error.filename}: {os.strerror(error.errno)}: {_FILE[error.errno]}{_cache_hint(error.filename)}"
        )
    if _is_ours(error):
        return None
    for number, fix in _DISK.items():
        if os.strerror(number) in str(error):
            return f"{os.strerror(number)}: {fix}"
    cause = error.__cause__ or error.__context__
    return None if cause is None else disk_problem(cause)


def _cache_hint(path: str | bytes) -> str:
    """For a path in a cache that libraries chose: how to choose another one."""
    for variable, folder in cache_folders().items():
        if Path(os.fsdecode(path)).is_relative_to(folder):
            return f" (set {variable} to a folder that can be written)"
    return ""


def cache_folders() -> dict[str, Path]:
    """The folders that libraries write into without being told to, by the variable that chooses another one."""
    home = Path(constants.HF_HOME)
    # As `datasets` and LeRobot choose them; importing these takes seconds.
    places = {
        "HF_DATASETS_CACHE": os.environ.get("HF_DATASETS_CACHE") or home / "datasets",
        "HF_LEROBOT_HOME": os.environ.get("HF_LEROBOT_HOME") or home / "lerobot",
        "HF_HOME": home,
    }
    return {variable: Path(folder).expanduser() for variable, folder in places.items()}


def line_for(error: Exception) -> str | None:
    """The one line that tells the user what to do; None for an error that keeps its traceback."""
    # LeRobot asks the Hub for a file that it cannot read on this machine: then the disk is the cause.
    if (problem := disk_problem(error)) is not None:
        return f"{problem}; then run the same command again; it resumes or starts over."
    # In a chain of errors the first about the Hub says most: those before wrap it, those after are httpx's.
    for cause in _causes(error):
        if (refusal := _hub_problem(cause)) is not None:
            return refusal
    if _is_ours(error):
        return one_line(error)
    if any(module.startswith(_PARSERS) for module in _modules(error)):
        reason = f" ({error.__cause__})" if error.__cause__ else ""
        return f"cannot read the flags or a configuration file. {type(error).__name__}: {one_line(f'{error}{reason}')}"
    return None


def _is_ours(error: BaseException) -> bool:
    """Whether this package raised the error for the user to read."""
    if isinstance(error, WorkerError):
        return True
    modules = _modules(error)
    return (
        bool(modules)
        and modules[-1].split(".")[0] == _OURS
        and isinstance(error, ValueError | OSError | RuntimeError)
    )


def _modules(error: BaseException) -> list[str]:
    """The modules that an error passed through; the one that raised it is last."""
    return [frame.f_globals["__name__"] for frame, _ in walk_tb(error.__traceback__)]


def _causes(error: BaseException | None) -> Iterator[BaseException]:
    """An error and its causes, the original one last."""
    while error is not None:
        yield error
        error = error.__cause__ or (None if error.__suppress_context__ else error.__context__)


def one_line(text: object) -> str:
    """A message without line breaks and repeated spaces."""
    return " ".join(str(text).split())


def check_can_push(repo_id: str) -> None:
    """Check that the user may push to a repository, before work is done whose result would be refused.

    Raises:
        HubRefusalError: The token cannot write to the repository's namespace.
        LocalTokenNotFoundError, HfHubHTTPError, ConnectionError: There is no token, the Hub refuses it, or cannot be
            reached.
    """
    user = whoami()
    if user["auth"].get("accessToken", {}).get("role") == "read":
        raise HubRefusalError(
            f"pushing to {repo_id} needs a token with write access, but the token of {user['name']} is read-only: "
            f"{LOGIN}, with another token."
        )
    namespaces = [user["name"], *(organization["name"] for organization in user["orgs"])]
    owner = repo_id.split("/")[0] if "/" in repo_id else user["name"]
    if owner not in namespaces:
        raise HubRefusalError(
            f"{repo_id} belongs to {owner}, but the token is of {user['name']}, who can write to "
            f"{', '.join(namespaces)}: push to {user['name']}/{repo_id.split('/')[1]}, or {LOGIN} as {owner}."
        )


def _hub_problem(error: BaseException) -> str | None:
    """What happened on the Hub and how to fix it; None for other errors."""
    match error:
        case HubRefusalError():
            return str(error)
        case OfflineModeIsEnabled():
            return "the Hub is needed, but HF_HUB_OFFLINE is set: unset it, or use files on this machine."
        case LocalTokenNotFoundError():
            return f"the Hub asks for a token and there is none: {LOGIN}."
        case HFValidationError():
            return f"neither a folder on this machine nor a repository name, user/name. {one_line(error)}"
        case HfHubHTTPError():
            # Its message has the address, and for the most part what to check.
            refused = error.response.status_code in (401, 403)
            return f"{one_line(error)} For a private repository, {LOGIN}." if refused else one_line(error)
        case httpx.TransportError():
            return _connection_problem(error)
    return None


def _connection_problem(error: httpx.TransportError) -> str:
    try:
        request = error.request
    except RuntimeError:  # it belongs to no request
        return f"no connection to the Hub ({type(error).__name__}): run the command again."
    found = f"lost the connection to {request.url.host} ({type(error).__name__}) "
    if request.method in _READING:
        return (
            f"{found}while reading {request.url.path}: check the network and run the command again; files that arrived "
            "are not downloaded twice. With HF_HUB_OFFLINE=1, files on this machine are used."
        )
    return (
        f"{found}while writing to {request.url.path}: an unfinished push changes nothing on the Hub. Run the command "
        "again; files that arrived are not sent twice."
    )
