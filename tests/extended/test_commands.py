"""docs/commands.md, in its order, at a size for tests."""

from collections.abc import Callable
from pathlib import Path

import pytest

from lerobot_wm.cli import COMMANDS
from tests.documents import commands, tables, with_flags
from tests.flags import SMALL_WORLD_MODEL

DOCUMENT = "docs/commands.md"
TASKS = "reach-v3,window-close-v3"


def small(words: list[str]) -> list[str]:
    """The command at a size for tests."""
    match words[1]:
        case "train" if "--resume=true" not in words:
            sizes = {"steps": 2, "batch_size": 2}
            return [
                *with_flags(words, **sizes),
                *SMALL_WORLD_MODEL.split(),
                "--policy.device=cpu",
                "--num_workers=0",
            ]
        case "eval":
            sizes = {"env.task": "reach-v3", "eval.n_episodes": 1}
            return [*with_flags(words, **sizes), "--env.episode_length=5", "--policy.device=cpu"]
        case "collect":
            return with_flags(words, tasks=TASKS, episodes_per_task=2)
        case "expert":
            return with_flags(words, tasks=TASKS, variations="0-1")
        case _:
            return words


@pytest.mark.slow
def test_the_commands_work_as_written(
    tmp_path: Path,
    demos_root: Path,
    policy_paths: dict[str, Path],
    monkeypatch: pytest.MonkeyPatch,
    lerobot_wm_command: Callable[..., None],
) -> None:
    monkeypatch.chdir(tmp_path)
    for place, target in (
        ("data/mt6", demos_root),
        ("outputs/bc/checkpoints/last", policy_paths["wm_bc"].parent),
        ("outputs/iql/checkpoints/last", policy_paths["wm_iql"].parent),
    ):
        Path(place).parent.mkdir(parents=True)
        Path(place).symlink_to(target)
    for words in commands(DOCUMENT):
        lerobot_wm_command(*small(words)[1:])
    for made in (
        "wm/checkpoints/000002",
        "dream/episode_3.mp4",
        "replay/replay.json",
        "eval/records.jsonl",
        "eval_noise/records.jsonl",
        "report/index.html",
        "quality/quality.json",
        "expert/records.jsonl",
        "untrained/pretrained_model",
        "backbone/pretrained_model",
    ):
        assert Path("outputs", made).exists(), made
    assert Path("data/mt6_dense/meta/info.json").is_file()
    assert Path("data/mt6_repaired/meta/info.json").is_file()


def test_every_command_is_in_the_table() -> None:
    listed = {
        row["command"].strip("`").removeprefix("lerobot-wm ")
        for row in tables(DOCUMENT, "# Every command")[0]
    }
    assert listed == set(COMMANDS)


def test_every_command_has_an_example() -> None:
    shown = {
        words[1]
        for name in ("README.md", DOCUMENT, "docs/hub.md")
        for words in commands(name)
        if words[0] == "lerobot-wm"
    }
    assert shown == set(COMMANDS)
