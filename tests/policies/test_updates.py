"""--policy.updates_per_step: several updates in one step of LeRobot's loop."""

from collections.abc import Callable
from pathlib import Path

import pytest
import torch
from lerobot.utils.constants import OPTIMIZER_STATE
from safetensors.torch import load_file

from lerobot_wm.policies.wm_bc.configuration_wm_bc import WMBCConfig
from lerobot_wm.train.accelerator import DivergenceError
from tests.flags import TRAIN_FLAGS

Train = Callable[..., dict[str, torch.Tensor]]


@pytest.fixture
def train(
    latents_root: Path, world_model_path: Path, tmp_path: Path, lerobot_wm_command: Callable[..., None]
) -> Train:
    """Train a small policy on latents; the tensors of its last checkpoint, Adam's among them."""

    def run(name: str, *flags: str) -> dict[str, torch.Tensor]:
        lerobot_wm_command(
            f"train --policy.world_model_path={world_model_path} --policy.hidden_dims=[16,16]",
            f"--dataset.repo_id=test/latents --dataset.root={latents_root} --output_dir={tmp_path / name}",
            TRAIN_FLAGS,
            *flags,
        )
        return checkpoint(tmp_path / name)

    return run


def checkpoint(run: Path) -> dict[str, torch.Tensor]:
    last = run / "checkpoints" / "last"
    weights = load_file(last / "pretrained_model" / "model.safetensors")
    optimizer = load_file(last / "training_state" / OPTIMIZER_STATE)
    return {name: tensor for name, tensor in weights.items() if "world_model" not in name} | optimizer


@pytest.mark.parametrize(
    ("policy", "clip", "dtype"),
    [("wm_bc", 0.1, "float32"), ("wm_iql", 0, "float32"), ("wm_iql", 0, "bfloat16")],
)
def test_the_updates_are_those_of_as_many_steps(train: Train, policy: str, clip: float, dtype: str) -> None:
    """Bit for bit, at a constant rate: schedules move on once a step."""
    flags = (
        f"--policy.type={policy} --policy.dtype={dtype} --save_freq=100",
        "--use_policy_training_preset=false --optimizer.type=fused_adam --optimizer.lr=3e-4",
        f"--optimizer.grad_clip_norm={clip} --scheduler.type=final_decay --scheduler.share=1e-9",  # never falls
    )
    single = train("single", *flags, "--batch_size=4 --steps=12")
    several = train("several", *flags, "--batch_size=16 --steps=3 --policy.updates_per_step=4")
    assert several.keys() == single.keys()
    for name, tensor in single.items():
        torch.testing.assert_close(several[name], tensor, rtol=0, atol=0, msg=name)
    assert {int(tensor) for name, tensor in several.items() if name.endswith("step")} == {12}


def test_a_resumed_training_ends_as_an_uninterrupted_one(
    train: Train, tmp_path: Path, lerobot_wm_command: Callable[..., None], latents_root: Path
) -> None:
    """Over the end of an epoch, whose last batch is filled up."""
    flags = "--policy.type=wm_bc --batch_size=512 --policy.updates_per_step=4 --save_freq=2"
    whole = train("whole", flags, "--steps=6")
    train("stopped", flags, "--steps=4")
    config = tmp_path / "stopped" / "checkpoints" / "last" / "pretrained_model" / "train_config.json"
    lerobot_wm_command(f"train --config_path={config} --resume=true --steps=6")
    for name, tensor in checkpoint(tmp_path / "stopped").items():
        torch.testing.assert_close(tensor, whole[name], rtol=0, atol=0, msg=name)


def test_a_batch_that_cannot_be_shared(train: Train, tmp_path: Path) -> None:
    with pytest.raises(ValueError, match=r"batch_size=10 cannot .*updates_per_step=4, .*: give a multiple"):
        train("run", "--policy.type=wm_bc --batch_size=10 --steps=1 --policy.updates_per_step=4")
    assert not (tmp_path / "run" / "checkpoints").exists()


def test_none_is_too_few() -> None:
    with pytest.raises(ValueError, match="updates_per_step is 0; a step makes 1 or more"):
        WMBCConfig(updates_per_step=0)


def test_lerobots_own_command_refuses(
    lerobot_train_command: Callable[[str], None], latents_root: Path, world_model_path: Path, tmp_path: Path
) -> None:
    """It would make one update on the whole batch."""
    with pytest.raises(ValueError, match=r"updates_per_step=2 is for lerobot-wm train"):
        lerobot_train_command(
            f"--policy.type=wm_bc --policy.world_model_path={world_model_path} --batch_size=8 --steps=1 "
            f"--policy.updates_per_step=2 --dataset.repo_id=test/latents --dataset.root={latents_root} "
            f"{TRAIN_FLAGS} --output_dir={tmp_path / 'run'}"
        )


def test_a_training_that_diverges_on_the_way_stops(train: Train) -> None:
    with pytest.raises(DivergenceError, match="NaN or Inf"):
        train(
            "run",
            "--policy.type=wm_iql --batch_size=16 --steps=1 --policy.updates_per_step=4 --policy.lr=1e38",
        )


def test_validation_takes_the_loss_of_whole_batches(train: Train) -> None:
    """It changes no weights."""
    flags = (
        "--policy.type=wm_iql --batch_size=8 --steps=2 --policy.updates_per_step=2 --dataset.eval_split=0.3"
    )
    without = train("without", flags, "--eval_steps=0")
    validated = train("with", flags, "--eval_steps=1")
    for name, tensor in without.items():
        torch.testing.assert_close(validated[name], tensor, rtol=0, atol=0, msg=name)
