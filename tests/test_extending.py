"""docs/extending.md, as a reader would try it: the file written down, then the commands."""

import os
import subprocess
import sys
from pathlib import Path

import pytest

from tests.documents import blocks, commands, with_flags


@pytest.mark.slow
def test_the_policy_of_the_page_trains_and_acts(
    tmp_path: Path, demos_root: Path, world_model_path: Path
) -> None:
    [program] = blocks("docs/extending.md", "python")
    (tmp_path / "wm_linear").mkdir()
    (tmp_path / "wm_linear" / "__init__.py").write_text(program)
    train, evaluate = commands("docs/extending.md")
    train = with_flags(
        train,
        **{
            "dataset.repo_id": "test/demos",
            "dataset.root": demos_root,
            "policy.world_model_path": world_model_path,
        },
        steps=3,
        batch_size=8,
    )
    evaluate = with_flags(evaluate, **{"env.task": "reach-v3", "eval.n_episodes": 1, "eval.batch_size": 1})
    environment = {**os.environ, "PYTHONPATH": str(tmp_path), "OMP_NUM_THREADS": "1"}
    for command in (
        [*train, "--policy.device=cpu"],
        [*evaluate, "--env.episode_length=5", "--output_dir=outputs/eval"],
    ):
        program_path = Path(sys.executable).parent / command[0]
        done = subprocess.run(
            [program_path, *command[1:]], cwd=tmp_path, env=environment, capture_output=True, text=True
        )
        assert done.returncode == 0, done.stderr[-3000:]
    assert (tmp_path / "outputs" / "eval" / "eval_info.json").is_file()
