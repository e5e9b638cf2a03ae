"""Trained checkpoints in closed loop, through LeRobot's own evaluation command."""

import json
import sys
from collections.abc import Callable
from pathlib import Path

import pytest
from lerobot.scripts import lerobot_eval

from tests.flags import DATASET_FLAGS, TRAIN_FLAGS


@pytest.mark.parametrize("policy_type", ["wm_bc", "wm_iql"])
def test_lerobot_eval_needs_nothing_but_the_checkpoint(
    policy_type: str, policy_paths: dict[str, Path], tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    flags = (
        f"--policy.path={policy_paths[policy_type]} --policy.device=cpu --env.type=metaworld_mt "
        "--env.task=reach-v3,window-close-v3 --env.episode_length=8 --eval.n_episodes=2 --eval.batch_size=2 "
        f"--eval.use_async_envs=false --seed=0 --output_dir={tmp_path}"
    )
    monkeypatch.setattr(sys, "argv", ["lerobot-eval", *flags.split()])
    lerobot_eval.main()
    info = json.loads((tmp_path / "eval_info.json").read_text())
    assert set(info["per_group"]) == {"reach-v3", "window-close-v3"}
    assert info["overall"]["n_episodes"] == 4
    assert len(list(tmp_path.rglob("*.mp4"))) == 4


def test_a_task_the_policy_does_not_know_ends_the_evaluation(
    policy_paths: dict[str, Path], tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    flags = (
        f"--policy.path={policy_paths['wm_bc']} --policy.device=cpu --env.type=metaworld_mt --env.task=drawer-open-v3 "
        f"--eval.n_episodes=1 --eval.use_async_envs=false --seed=0 --output_dir={tmp_path}"
    )
    monkeypatch.setattr(sys, "argv", ["lerobot-eval", *flags.split()])
    with pytest.raises(ValueError, match=r"Unknown task \['Open a drawer'\]"):
        lerobot_eval.main()


def test_the_state_oracle_is_given_the_state(
    demos_root: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, lerobot_wm_command: Callable[..., None]
) -> None:
    lerobot_wm_command(
        "train --policy.type=wm_bc --policy.use_latent=false --policy.use_environment_state=true",
        f"--steps=1 --batch_size=8 {TRAIN_FLAGS} {DATASET_FLAGS.format(root=demos_root)}",
        f"--output_dir={tmp_path / 'run'}",
    )
    flags = (
        f"--policy.path={tmp_path / 'run' / 'checkpoints' / 'last' / 'pretrained_model'} --policy.device=cpu "
        "--env.type=metaworld_mt --env.task=reach-v3 --env.episode_length=4 --eval.n_episodes=1 --eval.batch_size=1 "
        f"--eval.use_async_envs=false --seed=0 --output_dir={tmp_path / 'eval'}"
    )
    monkeypatch.setattr(sys, "argv", ["lerobot-eval", *flags.split()])
    with pytest.raises(ValueError, match=r"--env\.environment_state=true"):
        lerobot_eval.main()
    monkeypatch.setattr(sys, "argv", ["lerobot-eval", *flags.split(), "--env.environment_state=true"])
    lerobot_eval.main()
    assert (tmp_path / "eval" / "eval_info.json").is_file()
