"""What `lerobot-wm train` changes of LeRobot's train(), on whichever LeRobot version is installed."""

from collections.abc import Callable
from pathlib import Path
from typing import Any

import pytest
import torch
from accelerate.state import AcceleratorState
from lerobot.configs import PreTrainedConfig
from lerobot.configs.default import DatasetConfig
from lerobot.configs.train import TrainPipelineConfig
from lerobot.policies.act.configuration_act import ACTConfig
from lerobot.scripts import lerobot_train

from lerobot_wm.data.loader import RamLoader
from lerobot_wm.policies.e2e_bc.configuration_e2e_bc import E2EBCConfig
from lerobot_wm.train.seam import start_processes, train_from_memory
from tests.flags import DATASET_FLAGS, TRAIN_FLAGS

TAKES_ACCELERATOR = not hasattr(lerobot_train, "make_dataloaders")  # LeRobot 0.6.1


@pytest.fixture
def given_to_lerobot(monkeypatch: pytest.MonkeyPatch) -> list[tuple[TrainPipelineConfig, dict[str, Any]]]:
    """What LeRobot's train() is called with, in place of its being run."""
    calls: list[tuple[TrainPipelineConfig, dict[str, Any]]] = []
    monkeypatch.setattr(lerobot_train, "train", lambda cfg, **given: calls.append((cfg, given)))
    return calls


def test_the_gpu_is_the_one_that_was_named(monkeypatch: pytest.MonkeyPatch) -> None:
    """Accelerate takes the current one, and evaluation the one that was named."""
    chosen = []
    policy = E2EBCConfig(device="cpu", dtype="float32", push_to_hub=False)
    monkeypatch.setattr(torch.cuda, "set_device", chosen.append)
    for device in ("cuda:1", "cuda", "cpu"):
        policy.device = device
        AcceleratorState._reset_state(reset_partial_state=True)
        start_processes(policy)
    assert chosen == [torch.device("cuda:1")]


@pytest.mark.parametrize(
    ("policy", "launched_with", "expected"),
    [
        (ACTConfig(device="cpu", use_amp=True), None, "bf16"),
        (ACTConfig(device="cpu"), None, "no"),
        (ACTConfig(device="cpu"), "bf16", "bf16"),
        (E2EBCConfig(device="cpu", dtype="float32", push_to_hub=False), "bf16", "no"),
        (E2EBCConfig(device="cpu", dtype="bfloat16", push_to_hub=False), None, "bf16"),
    ],
)
def test_the_precision_is_the_policys(
    policy: PreTrainedConfig,
    launched_with: str | None,
    expected: str,
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
    given_to_lerobot: list[tuple[TrainPipelineConfig, dict[str, Any]]],
) -> None:
    if launched_with is not None:
        monkeypatch.setenv("ACCELERATE_MIXED_PRECISION", launched_with)
    train_from_memory(TrainPipelineConfig(DatasetConfig("test/demos"), policy=policy, output_dir=tmp_path))
    [(cfg, given)] = given_to_lerobot
    if TAKES_ACCELERATOR:
        assert given["accelerator"].mixed_precision == expected
    elif isinstance(policy, E2EBCConfig):
        assert cfg.accelerator.mixed_precision == expected
    else:  # LeRobot decides, by --accelerator.mixed_precision alone
        assert cfg.accelerator.mixed_precision == "no"


@pytest.mark.skipif(not TAKES_ACCELERATOR, reason="this LeRobot makes its own Accelerator")
@pytest.mark.parametrize(
    ("policy", "sends"), [(ACTConfig(device="cpu"), True), (E2EBCConfig(device="cpu"), False)]
)
def test_buffers_are_sent_around_where_processes_may_differ_in_them(
    policy: PreTrainedConfig,
    sends: bool,
    tmp_path: Path,
    given_to_lerobot: list[tuple[TrainPipelineConfig, dict[str, Any]]],
) -> None:
    """Ours are alike, and one can be as long as the dataset."""
    train_from_memory(TrainPipelineConfig(DatasetConfig("test/demos"), policy=policy, output_dir=tmp_path))
    assert given_to_lerobot[0][1]["accelerator"].ddp_handler.broadcast_buffers is sends


def test_training_and_held_out_loss_read_from_memory(
    demos_root: Path,
    tmp_path: Path,
    lerobot_wm_command: Callable[..., None],
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    """And LeRobot's script is as it was afterwards."""
    before = dict(vars(lerobot_train))
    sizes = []
    batches = RamLoader.__iter__

    def noted(self: RamLoader) -> Any:
        for batch in batches(self):
            sizes.append(len(batch["index"]))
            yield batch

    monkeypatch.setattr(RamLoader, "__iter__", noted)
    lerobot_wm_command(
        "train --policy.type=wm_bc --policy.use_latent=false --steps=2 --batch_size=8 --log_freq=1",
        f"--dataset.eval_split=0.3 --eval_steps=2 --max_eval_samples=4 --output_dir={tmp_path / 'run'}",
        TRAIN_FLAGS,
        DATASET_FLAGS.format(root=demos_root),
    )
    assert sizes == [8, 8, 4]
    assert dict(vars(lerobot_train)) == before
