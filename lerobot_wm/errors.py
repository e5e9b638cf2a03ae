"""How a command ends early: with one line that says what its user can do."""

import errno
import os
import sys
from collections.abc import Iterator
from contextlib import contextmanager
from traceback import clear_frames, walk_tb

from lerobot_wm.hub.errors import explain

INTERRUPTED = 130  # exit code of a command that Ctrl-C ended: 128 and the number of the signal
_OURS = "lerobot_wm"
# What a disk says, in any library's message, -> how to mend it.
_DISK = {
    errno.ENOSPC: "make room there, or choose another place",
    errno.EDQUOT: "make room there, or choose another place",
    errno.EROFS: "make it writable, or choose another place",
}
# What the system says of a file it names.
_FILE = {
    **_DISK,
    errno.EACCES: "make it accessible, or choose another place",
    errno.EPERM: "make it accessible, or choose another place",
    errno.EEXIST: "remove it, or choose another place",
    errno.ENOTDIR: "a file is where a folder should be",
}
_PARSERS = ("draccus", "lerobot.configs.policies", "lerobot.configs.train")


@contextmanager
def exit_with_one_line(command: str) -> Iterator[None]:
    """End the program with one line on errors that say how to mend them; other errors pass, with their traceback.

    These are Ctrl-C, a disk that takes no more, what the Hub refuses, flags and configurations that cannot be read, and
    what is raised in this package, not in a library below it: ValueError, OSError, RuntimeError and what is derived
    from them.

    Args:
        command: Its name, for the line.
    """
    try:
        yield
    except KeyboardInterrupt as stop:
        _close_bars(stop)
        how = str(stop) or "the same command goes on where it was, or begins again"
        print(f"\n{command}: interrupted; {how}.", file=sys.stderr)
        raise SystemExit(INTERRUPTED) from None
    except Exception as error:
        line = _line(error)
        if line is None:
            raise
        _close_bars(error)
        raise SystemExit(f"{command}: {line}") from error


def _close_bars(error: BaseException | None) -> None:
    """Have progress bars, which live in the frames that an error came through, write their last before our line."""
    while error is not None:
        clear_frames(error.__traceback__)
        error = error.__context__


class WorkerError(RuntimeError):
    """What a worker process ended with; its text is one line, which its traceback cannot tell in another process."""


@contextmanager
def explained_to_parent() -> Iterator[None]:
    """In a worker: pass what ends with one line on as that line.

    Raises:
        WorkerError: In place of such an error; others pass.
    """
    try:
        yield
    except Exception as error:
        line = _line(error)
        if line is None:
            raise
        raise WorkerError(line) from error


def disk_problem(error: BaseException) -> str | None:
    """What a disk refused, and how to mend it; None where the error is another, or has words of this package.

    Libraries that write files pass the system's words on, its number not always.
    """
    if isinstance(error, OSError) and error.filename and error.errno in _FILE:
        return f"{error.filename}: {os.strerror(error.errno)}: {_FILE[error.errno]}"
    if _is_ours(error):
        return None
    for number, mend in _DISK.items():
        if os.strerror(number) in str(error):
            return f"{os.strerror(number)}: {mend}"
    cause = error.__cause__ or error.__context__
    return None if cause is None else disk_problem(cause)


def _line(error: Exception) -> str | None:
    refusal = explain(error)
    if refusal is not None:
        return refusal
    problem = disk_problem(error)
    if problem is not None:
        return f"{problem}; then the same command goes on where it was, or begins again."
    if _is_ours(error):
        return " ".join(str(error).split())
    if any(module.startswith(_PARSERS) for module in _modules(error)):
        cause = f" ({error.__cause__})" if error.__cause__ else ""
        text = " ".join(f"{error}{cause}".split())
        return f"flags or a configuration file cannot be read. {type(error).__name__}: {text}"
    return None


def _is_ours(error: BaseException) -> bool:
    """Whether this package raised it, and it says how to mend it."""
    if isinstance(error, WorkerError):
        return True
    modules = _modules(error)
    return (
        bool(modules)
        and modules[-1].split(".")[0] == _OURS
        and isinstance(error, ValueError | OSError | RuntimeError)
    )


def _modules(error: BaseException) -> list[str]:
    """The modules that an error came through, that which raised it last."""
    return [frame.f_globals["__name__"] for frame, _ in walk_tb(error.__traceback__)]
