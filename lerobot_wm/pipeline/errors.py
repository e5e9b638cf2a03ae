"""The one line a command ends with when something is wrong that its user can mend."""

from collections.abc import Iterator
from contextlib import contextmanager
from traceback import walk_tb

from lerobot_wm.hub.errors import explain

_OURS = "lerobot_wm"
_PARSERS = ("draccus", "lerobot.configs.policies", "lerobot.configs.train")


@contextmanager
def exit_with_one_line(command: str) -> Iterator[None]:
    """End the program with one line on errors that say how to mend them; other errors pass, with their traceback.

    These are what the Hub refuses, flags and configurations that cannot be read, and what is raised in this
    package, not in a library below it: ValueError, OSError, RuntimeError and what is derived from them.

    Args:
        command: Its name, for the line.
    """
    try:
        yield
    except Exception as error:
        line = explain(error) or _explain(error)
        if line is None:
            raise
        raise SystemExit(f"{command}: {line}") from error


def _explain(error: Exception) -> str | None:
    modules = [frame.f_globals["__name__"] for frame, _ in walk_tb(error.__traceback__)]
    if modules[-1].split(".")[0] == _OURS and isinstance(error, ValueError | OSError | RuntimeError):
        return " ".join(str(error).split())
    if any(module.startswith(_PARSERS) for module in modules):
        cause = f" ({error.__cause__})" if error.__cause__ else ""
        text = " ".join(f"{error}{cause}".split())
        return f"flags or a configuration file cannot be read. {type(error).__name__}: {text}"
    return None
