"""Commands that end by SIGKILL at a moment of choice: just before they touch the files of a folder for the n-th time.

Run as a script it imports what commands need, once, and forks for each it is told on its standard input.
"""

import hashlib
import json
import os
import signal
import subprocess
import sys
from pathlib import Path
from typing import Any

# What the interpreter announces before it does it: https://docs.python.org/3/library/audit_events.html
_TOUCHES = {
    "open",
    "os.link",
    "os.mkdir",
    "os.remove",
    "os.rename",
    "os.rmdir",
    "os.symlink",
    "shutil.rmtree",
}


def digests(folder: Path) -> dict[str, str]:
    """SHA-256 of every file of a folder, by its path in there."""
    return {
        str(path.relative_to(folder)): hashlib.sha256(path.read_bytes()).hexdigest()
        for path in sorted(folder.rglob("*"))
        if path.is_file()
    }


class WatchedCommands:
    """Runs `lerobot-wm` commands, each in a process of its own.

    Args:
        notes: Folder for its notes.

    Attributes:
        touches: Those of the last command as lines `event path`, paths relative to the folder watched. Where it was
            killed, the last of them was not done.
    """

    def __init__(self, notes: Path) -> None:
        self.touches: list[str] = []
        self._notes = notes / "touches"
        self._server = subprocess.Popen(
            [sys.executable, __file__, str(self._notes)],
            stdin=subprocess.PIPE,
            stdout=subprocess.PIPE,
            text=True,
            env={**os.environ, "OMP_NUM_THREADS": "1"},
        )

    def run(self, arguments: str, folder: Path, kill_at: int | None = None) -> bool:
        """Run one command.

        Args:
            arguments: Separated by spaces.
            folder: Whose files are watched.
            kill_at: Number of the touch, from 0, just before which it is killed; None lets it live.

        Returns:
            Whether it was killed; not where it ended before that.
        """
        assert self._server.stdin is not None
        assert self._server.stdout is not None
        self._notes.write_text("")
        print(json.dumps([arguments, str(folder), kill_at]), file=self._server.stdin, flush=True)
        status = int(self._server.stdout.readline())
        self.touches = self._notes.read_text().splitlines()
        killed = kill_at is not None and len(self.touches) == kill_at + 1
        assert status == (-signal.SIGKILL if killed else 0)
        return killed

    def close(self) -> None:
        """End the server."""
        self._server.communicate(timeout=30)


def _run_watched(arguments: str, folder: str, kill_at: int | None, notes: str) -> None:
    from lerobot_wm import cli

    file = open(notes, "a", buffering=1)  # noqa: SIM115 (for as long as the process lives)
    count = 0

    def watch(event: str, args: tuple[Any, ...]) -> None:
        nonlocal count
        if event not in _TOUCHES or (event == "open" and not args[2] & (os.O_WRONLY | os.O_RDWR)):
            return
        paths = [os.fspath(path) for path in args[:2] if isinstance(path, str | os.PathLike)]
        inside = [path for path in paths if path.startswith(f"{folder}{os.sep}")]
        if inside:
            file.write(f"{event} {inside[-1].removeprefix(folder)[1:]}\n")
            if count == kill_at:
                os.kill(os.getpid(), signal.SIGKILL)
            count += 1

    sys.addaudithook(watch)
    sys.argv = ["lerobot-wm", *arguments.split()]
    cli.main()


def _serve(notes: str) -> None:
    # What takes seconds to import; no import starts a thread, which a fork would not take along.
    import lerobot_wm.encode.command
    import lerobot_wm.evaluate.command
    import lerobot_wm.train.command  # noqa: F401

    for line in sys.stdin:
        arguments, folder, kill_at = json.loads(line)
        process = os.fork()
        if process == 0:
            os.dup2(2, 1)  # what commands print is no answer
            _run_watched(arguments, folder, kill_at, notes)
            return
        print(os.waitstatus_to_exitcode(os.waitpid(process, 0)[1]), flush=True)


if __name__ == "__main__":
    _serve(sys.argv[1])
