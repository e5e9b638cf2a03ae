"""README's "With your own hands", in its order, at a size for tests; tables and links of the documents."""

import re
import sys
from collections.abc import Callable
from pathlib import Path

import pytest
from lerobot.scripts import lerobot_eval, lerobot_train

from lerobot_wm.cli import COMMANDS
from lerobot_wm.envs.tasks import resolve_tasks
from tests.documents import ROOT, commands, with_flags
from tests.flags import SMALL_WORLD_MODEL

CHECKPOINT = "outputs/iql/checkpoints/last/pretrained_model"


def by_hand() -> list[list[str]]:
    """The commands from collection on, to loading the policy."""
    all_commands = commands("README.md")
    first = next(i for i, words in enumerate(all_commands) if words[:2] == ["lerobot-wm", "collect"])
    last = next(i for i, words in enumerate(all_commands) if words[0] == "python")
    return all_commands[first : last + 1]


def test_the_commands_work_as_written(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, lerobot_wm_command: Callable[..., None]
) -> None:
    monkeypatch.chdir(tmp_path)

    def run(main: Callable[[], None], words: list[str]) -> None:
        monkeypatch.setattr(sys, "argv", words)
        main()

    collect, world_model, encode, policy, evaluate, load = by_hand()
    on_cpu = ["--policy.device=cpu", "--num_workers=0"]
    lerobot_wm_command(*with_flags(collect, episodes_per_task=1, noise=0)[1:], "--num_workers=1")
    small = [*SMALL_WORLD_MODEL.split(), *on_cpu]
    run(lerobot_train.main, [*with_flags(world_model, steps=2, batch_size=2), *small])
    lerobot_wm_command(*encode[1:], "--device=cpu")
    run(lerobot_train.main, [*with_flags(policy, steps=2, batch_size=8), *on_cpu])
    few = with_flags(evaluate, **{"eval.n_episodes": 1, "eval.batch_size": 1})
    run(
        lerobot_eval.main,
        [*few, "--env.episode_length=3", "--output_dir=outputs/eval", "--policy.device=cpu"],
    )
    assert len(list(Path("outputs/eval/videos").glob("*/*.mp4"))) == len(resolve_tasks("mt6"))
    program = load[2]
    assert "'test/wm_iql'" in program
    exec(program.replace("test/wm_iql", CHECKPOINT))


def test_every_subcommand_is_in_the_table() -> None:
    rows = [
        line for line in (ROOT / "README.md").read_text().splitlines() if line.startswith("| `lerobot-wm ")
    ]
    assert {row.split("`")[1].removeprefix("lerobot-wm ") for row in rows} == set(COMMANDS)


@pytest.mark.parametrize(
    "document",
    ["README.md", "CONTRIBUTING.md", *(f"docs/{path.name}" for path in sorted((ROOT / "docs").glob("*.md")))],
)
def test_links_within_the_repository_lead_somewhere(document: str) -> None:
    text = (ROOT / document).read_text()
    for target in re.findall(r"\]\(([^)#\s]+)[^)]*\)", text):
        if not target.startswith(("http://", "https://")):
            assert (ROOT / document).parent.joinpath(target).exists(), target


def test_messages_in_troubleshooting_are_those_of_the_code() -> None:
    page = (ROOT / "docs" / "troubleshooting.md").read_text()
    quoted = re.findall(r"^\| `([^`]+)` \|", page, re.MULTILINE)
    assert len(quoted) > 8
    code = "\n".join(path.read_text() for path in (ROOT / "lerobot_wm").rglob("*.py"))
    code = re.sub(r'"\s*\n\s*f?"', "", code)  # messages that go on in the next line
    for message in quoted:
        pattern = ".*".join(re.escape(part) for part in message.split("..."))
        assert re.search(pattern, code), message
