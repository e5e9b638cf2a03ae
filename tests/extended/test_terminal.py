"""What a person sees of a command: bars, tables that fit, colours on a terminal alone, no chatter of libraries."""

import logging
import os
import pty
import re
import termios
from collections.abc import Callable
from concurrent.futures import ThreadPoolExecutor
from contextlib import redirect_stderr, redirect_stdout
from pathlib import Path

import pytest
from lerobot.utils.import_utils import get_safe_default_video_backend

from lerobot_wm.system import hide_harmless_messages
from tests.flags import DATASET_FLAGS

COLUMNS = 100
# Name of a command -> its flags, and the bar that shows how far it is.
COMMANDS = {
    "expert": ("--tasks=reach-v3 --variations=0,10 --num_workers=1 --output_dir=out", "Rolling out: 100%"),
    "eval": (
        "--policy.path={policy} --policy.device=cpu --env.type=metaworld_mt --env.task=reach-v3 "
        "--env.episode_length=3 --eval.n_episodes=11 --seed=0 --output_dir=out",
        "Rolling out: 100%",
    ),
    "encode": (
        "--world_model_path={world_model} --device=cpu {dataset} --output_repo_id=test/l --output_root=out",
        "Encoding: 100%",
    ),
    "rename": (
        '--rename_map={{"next.dense_reward":"next.shaped"}} {dataset} --output_repo_id=test/d --output_root=out',
        "Copying: 100%",
    ),
}


@pytest.fixture
def command(
    demos_root: Path,
    world_model_path: Path,
    policy_paths: dict[str, Path],
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
    caplog: pytest.LogCaptureFixture,
    lerobot_wm_command: Callable[..., None],
) -> Callable[[str], None]:
    """Runs one of `COMMANDS`, in an empty folder and with logging as in a new process."""
    monkeypatch.chdir(tmp_path)
    caplog.set_level(logging.WARNING)
    monkeypatch.setenv("TERM", "xterm-256color")
    for variable in ("COLUMNS", "NO_COLOR", "FORCE_COLOR"):
        monkeypatch.delenv(variable, raising=False)

    def run(name: str) -> None:
        flags = COMMANDS[name][0].format(
            policy=policy_paths["wm_bc"],
            world_model=world_model_path,
            dataset=DATASET_FLAGS.format(root=demos_root),
        )
        with monkeypatch.context() as new_process:
            new_process.setattr(logging.getLogger(), "handlers", [])
            new_process.setattr(logging.getLogger("lerobot.utils.import_utils"), "filters", [])
            lerobot_wm_command(f"{name} {flags}")

    return run


def on_a_terminal(run: Callable[[], None]) -> str:
    """What `run` writes where stdout and stderr are a terminal of `COLUMNS` columns."""
    ours, screens = pty.openpty()
    termios.tcsetwinsize(screens, (40, COLUMNS))
    with ThreadPoolExecutor(1) as pool:
        written = pool.submit(_read_all, ours)
        with open(screens, "w") as screen, redirect_stdout(screen), redirect_stderr(screen):
            run()
    os.close(ours)
    return written.result()


def _read_all(terminal: int) -> str:
    """All that is written to a terminal until its other end is closed."""
    chunks = []
    while True:
        try:
            chunks.append(os.read(terminal, 65536))
        except OSError:  # how Linux says that it was closed
            return b"".join(chunks).decode()


@pytest.mark.parametrize("name", COMMANDS)
def test_on_a_terminal_there_is_a_bar_and_all_fits(name: str, command: Callable[[str], None]) -> None:
    text = on_a_terminal(lambda: command(name))
    assert COMMANDS[name][1] in text
    lines = re.split(r"[\r\n]+", re.sub(r"\x1b\[[0-9;]*[A-Za-z]", "", text))
    assert [line for line in lines if len(line) > COLUMNS] == []
    assert ("\x1b[1m" in text) == (name in ("expert", "eval")), "the heads of tables are bold"


@pytest.mark.parametrize("name", COMMANDS)
def test_a_pipe_gets_neither_colours_nor_chatter(
    name: str, command: Callable[[str], None], capfd: pytest.CaptureFixture[str]
) -> None:
    capfd.readouterr()
    command(name)
    text = "".join(capfd.readouterr())
    assert "\x1b" not in text
    for remark in ("torchcodec", "OpenGL_accelerate", "No job name", "Svt", "libx264"):
        assert remark not in text
    assert (name == "eval") == ("11 of 11 rollouts" in text), "in place of a bar"


def test_what_is_wrong_with_a_decoder_is_not_dropped(caplog: pytest.LogCaptureFixture) -> None:
    caplog.set_level(logging.WARNING, "lerobot.utils.import_utils")
    hide_harmless_messages()
    get_safe_default_video_backend()  # torchcodec is not in the lock: nothing is wrong
    logging.getLogger("lerobot.utils.import_utils").warning("'torchcodec' is installed but cannot be loaded")
    assert caplog.messages == ["'torchcodec' is installed but cannot be loaded"]
