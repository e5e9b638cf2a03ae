"""docs/extending.md, as a reader would try it: the files written down, then the commands."""

import os
import subprocess
import sys
from collections.abc import Callable
from pathlib import Path

import pytest
import torch
from lerobot.datasets.lerobot_dataset import LeRobotDataset
from lerobot.policies.factory import get_policy_class

from lerobot_wm.policies.latent.policy import LatentPolicy
from tests.documents import blocks, commands, with_flags
from tests.flags import TRAIN_FLAGS
from tests.recording import FRONT, WRIST, camera, record, vector

DOCUMENT = "docs/extending.md"


def write_packages(folder: Path) -> None:
    """The packages of the page, which a reader would write."""
    for name, program in zip(("wm_linear", "wm_gru"), blocks(DOCUMENT, "python"), strict=True):
        (folder / name).mkdir()
        (folder / name / "__init__.py").write_text(program)


@pytest.fixture
def dataset(tmp_path: Path) -> LeRobotDataset:
    """A robot with two cameras of different sizes."""
    features = {
        FRONT: camera(48, 64),
        WRIST: camera(32, 32),
        "observation.state": vector(5),
        "action": vector(3),
    }
    return record(tmp_path / "dataset", features, [("Reach", 6), ("Push", 12)])


def test_the_policy_and_the_world_model_of_the_page(
    tmp_path: Path,
    dataset: LeRobotDataset,
    monkeypatch: pytest.MonkeyPatch,
    lerobot_wm_command: Callable[..., None],
) -> None:
    """The world model encodes; policies on its latents have it in their checkpoint, and see what they learned from."""
    write_packages(tmp_path)
    monkeypatch.syspath_prepend(tmp_path)
    flags = f"--discover_packages_path=wm_gru {TRAIN_FLAGS} --batch_size=4 --log_freq=1"
    linear_flags = flags.replace("wm_gru", "wm_linear")
    images = f"--dataset.repo_id=test/recorded --dataset.root={dataset.root}"
    world_model = tmp_path / "gru" / "checkpoints" / "last" / "pretrained_model"
    lerobot_wm_command(
        f"train --policy.type=wm_gru {flags} --steps=2 {images} --output_dir={tmp_path / 'gru'}"
    )
    lerobot_wm_command(
        f"encode --discover_packages_path=wm_gru --world_model_path={world_model} --device=cpu {images}",
        f"--output_repo_id=test/latents --output_root={tmp_path / 'latents'}",
    )
    lerobot_wm_command(
        f"train --policy.type=wm_bc --policy.world_model_path={world_model} {flags} --steps=2",
        f"--dataset.repo_id=test/latents --dataset.root={tmp_path / 'latents'} --output_dir={tmp_path / 'bc'}",
    )
    lerobot_wm_command(
        f"train --policy.type=wm_linear --policy.world_model_path={world_model} {linear_flags} --steps=2",
        f"--dataset.repo_id=test/latents --dataset.root={tmp_path / 'latents'} --output_dir={tmp_path / 'linear'}",
    )
    gru = get_policy_class("wm_gru").from_pretrained(world_model)
    gru.config.repo_id = "user/gru"
    card = str(gru.generate_model_card("user/data", "wm_gru", None, None))
    assert "encoder = WMGRUPolicy.from_pretrained('user/gru').world_model" in card
    assert "select_action" not in card
    assert "--policy.world_model_path=user/gru" in card
    (world_model / "model.safetensors").unlink()
    encoded = LeRobotDataset("test/latents", root=tmp_path / "latents")
    for policy_type, run in (("wm_bc", "bc"), ("wm_linear", "linear")):
        policy = get_policy_class(policy_type).from_pretrained(
            tmp_path / run / "checkpoints" / "last" / "pretrained_model"
        )
        assert isinstance(policy, LatentPolicy)
        assert policy.config.world_model.type == "wm_gru"
        for index in range(6, 18):
            item = dataset[index]
            seen = {key: item[key][None] for key in (FRONT, WRIST, "observation.state")}
            assert policy.select_action({**seen, "task": ["Push"]}).shape == (1, 3)
            policy._prev_action = item["action"][None]
            latent = policy._filter_state.latent[0]
            torch.testing.assert_close(latent, encoded[index]["observation.latent"], atol=1e-5, rtol=1e-4)
        assert latent.std() > 0.01


def test_a_package_that_is_not_there(lerobot_wm_command: Callable[..., None]) -> None:
    with pytest.raises(SystemExit, match=r"lerobot-wm encode: .*not_there.*Verify the path"):
        lerobot_wm_command("encode --discover_packages_path=not_there")


@pytest.mark.slow
def test_the_commands_of_the_page(tmp_path: Path, demos_root: Path, world_model_path: Path) -> None:
    write_packages(tmp_path)
    (tmp_path / "data").mkdir()
    (tmp_path / "data" / "mt6").symlink_to(demos_root)
    wm = tmp_path / "outputs" / "wm" / "checkpoints" / "last"
    wm.mkdir(parents=True)
    (wm / "pretrained_model").symlink_to(world_model_path)
    environment = {**os.environ, "PYTHONPATH": str(tmp_path), "OMP_NUM_THREADS": "1"}
    evaluations = []
    for words in commands(DOCUMENT):
        if "train" in words[0] or words[1] == "train":
            words = [*with_flags(words, steps=3, batch_size=8), "--policy.device=cpu", "--num_workers=0"]
        elif words[0] == "lerobot-eval":
            evaluations.append(f"outputs/eval_{len(evaluations)}")
            few = with_flags(words, **{"env.task": "reach-v3", "eval.n_episodes": 1, "eval.batch_size": 1})
            words = [*few, "--env.episode_length=5", f"--output_dir={evaluations[-1]}"]
        done = subprocess.run(
            [Path(sys.executable).parent / words[0], *words[1:]],
            cwd=tmp_path,
            env=environment,
            capture_output=True,
            text=True,
        )
        assert done.returncode == 0, done.stderr[-3000:]
    assert len(evaluations) == 2
    assert all((tmp_path / folder / "eval_info.json").is_file() for folder in evaluations)
