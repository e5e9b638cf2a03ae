"""README's commands, in their order, at a size for tests; the links and the form of every document."""

import re
import sys
from collections.abc import Callable
from pathlib import Path

import pytest
from lerobot.scripts import lerobot_eval, lerobot_train

from lerobot_wm.envs.tasks import resolve_tasks
from tests.documents import ROOT, blocks, commands, documents, with_flags
from tests.flags import SMALL_WORLD_MODEL


def test_the_commands_work_as_written(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, lerobot_wm_command: Callable[..., None]
) -> None:
    monkeypatch.chdir(tmp_path)

    def run(main: Callable[[], None], words: list[str]) -> None:
        monkeypatch.setattr(sys, "argv", words)
        main()

    every = commands("README.md")
    first = next(i for i, words in enumerate(every) if words[:2] == ["lerobot-wm", "collect"])
    collect, world_model, encode, policy, evaluate = every[first:]
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
    [program] = blocks("README.md", "python")
    exec(program, {})


def test_readme_is_read_in_a_few_minutes() -> None:
    assert len((ROOT / "README.md").read_text().splitlines()) <= 120


@pytest.mark.parametrize("document", [*documents(), "CHANGELOG.md"])
def test_lines_are_short(document: str) -> None:
    lines = (ROOT / document).read_text().splitlines()
    assert not [line for line in lines if len(line) > 200 and not line.lstrip().startswith("|")]


@pytest.mark.parametrize("document", documents())
def test_links_within_the_repository_lead_somewhere(document: str) -> None:
    text = (ROOT / document).read_text()
    for target in re.findall(r"\]\(([^)#\s]+)[^)]*\)", text):
        if not target.startswith(("http://", "https://")):
            assert (ROOT / document).parent.joinpath(target).exists(), target
