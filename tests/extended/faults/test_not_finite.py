"""NaN and Inf: in data they are refused where data is written or read, in training they stop it before the weights."""

import math
from collections.abc import Callable
from functools import partial
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import pytest
import torch
from lerobot.datasets.dataset_metadata import LeRobotDatasetMetadata
from lerobot.datasets.lerobot_dataset import LeRobotDataset
from lerobot.policies import make_policy

from lerobot_wm.collect.shards import Shard, write_shard
from lerobot_wm.data.loader import RamDataset
from lerobot_wm.data.source import DatasetError, SourceConfig
from lerobot_wm.envs.simulation import Simulation
from lerobot_wm.policies.common.policy import DivergenceError, check_finite, check_finite_weights
from lerobot_wm.policies.wm_rssm.configuration_wm_rssm import WMRSSMConfig
from lerobot_wm.policies.wm_rssm.modeling_wm_rssm import WMRSSMPolicy
from lerobot_wm.world_model.config import RSSMConfig
from tests.extended.faults.breakage import DATA, set_value
from tests.flags import SMALL_WORLD_MODEL, TRAIN_FLAGS

CPU = torch.device("cpu")


@pytest.mark.parametrize(
    ("column", "value"),
    [("action", [math.nan, 0.0]), ("observation.state", [0.0, 0.0, math.inf]), ("next.reward", -math.inf)],
)
def test_data_is_refused_when_it_is_cached(column: str, value: Any, dataset: Path) -> None:
    set_value(dataset, DATA.format(1), column, row=3, value=value)
    expected = rf"{column} is NaN or Inf in episode 1 \(task 'Push'\), frame 3"
    with pytest.raises(DatasetError, match=expected):
        RamDataset(LeRobotDataset("test/faults", root=dataset), CPU)
    with pytest.raises(DatasetError, match=expected):
        SourceConfig("test/faults", str(dataset)).open()
    assert not dataset.with_name("dataset.cache").exists(), "images were decoded first"


def test_other_episodes_of_such_data_are_served(dataset: Path) -> None:
    set_value(dataset, DATA.format(1), "action", row=3, value=[math.nan, 0.0])
    RamDataset(LeRobotDataset("test/faults", root=dataset, episodes=[0, 2]), CPU, cameras={})


def test_data_is_refused_when_it_is_collected(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    step = Simulation.step

    def unstable(self: Simulation, action: Any) -> Any:
        outcome = step(self, action)
        return outcome._replace(dense_reward=math.inf) if outcome.success else outcome

    monkeypatch.setattr(Simulation, "step", unstable)
    shard = Shard("reach-v3", 7, 1, 42, (0,), 0.0, 2, 1, 0, 32, ("corner2",))
    with pytest.raises(
        ValueError, match=r"reach-v3, episode 7, variation 0, frame \d+: next.dense_reward is not finite"
    ):
        write_shard(shard, tmp_path)
    assert not (tmp_path / shard.name).exists()


def flags(dataset: Path, output_dir: Path) -> str:
    return (
        f"--policy.type=wm_rssm --policy.window_length=4 --batch_size=4 {SMALL_WORLD_MODEL} {TRAIN_FLAGS} "
        "--policy.dtype=float32 --log_freq=1 --save_freq=1 --steps=6 "
        f"--dataset.repo_id=test/faults --dataset.root={dataset} --output_dir={output_dir}"
    )


@pytest.mark.parametrize("command", ["lerobot-wm train", "lerobot-train"])
def test_training_that_diverges_keeps_its_last_good_checkpoint(
    command: str,
    dataset: Path,
    tmp_path: Path,
    lerobot_wm_command: Callable[..., None],
    lerobot_train_command: Callable[[str], None],
) -> None:
    # The first step is taken from a finite loss, to weights of 1e30.
    diverging = f"{flags(dataset, tmp_path / 'run')} --policy.lr=1e30"
    run = lerobot_train_command if command == "lerobot-train" else partial(lerobot_wm_command, "train")
    with pytest.raises(DivergenceError) as end:
        run(diverging)
    assert "--policy.lr" in str(end.value)
    checkpoints = tmp_path / "run" / "checkpoints"
    assert sorted(path.name for path in checkpoints.iterdir()) == ["000001", "last"]
    WMRSSMPolicy.from_pretrained(checkpoints / "last" / "pretrained_model")  # which refuses NaN


def test_training_on_broken_data_does_not_begin(
    dataset: Path, tmp_path: Path, lerobot_wm_command: Callable[..., None]
) -> None:
    set_value(dataset, DATA.format(2), "next.reward", row=1, value=math.nan)
    with pytest.raises(DatasetError, match=r"next.reward .*episode 2 \(task 'Lift'\), frame 1"):
        lerobot_wm_command("train", flags(dataset, tmp_path / "run"))
    assert not (tmp_path / "run" / "checkpoints").exists()


def test_a_policys_training_on_broken_data_encodes_nothing(
    dataset: Path, tmp_path: Path, lerobot_wm_command: Callable[..., None]
) -> None:
    lerobot_wm_command(
        f"init --policy.type=wm_rssm --policy.device=cpu {SMALL_WORLD_MODEL} --output_dir={tmp_path / 'wm'}",
        f"--dataset.repo_id=test/faults --dataset.root={dataset}",
    )
    set_value(dataset, DATA.format(2), "action", row=1, value=[0.0, math.nan])
    with pytest.raises(DatasetError, match=r"action is NaN or Inf in episode 2 \(task 'Lift'\), frame 1"):
        lerobot_wm_command(
            f"train --policy.type=wm_bc --policy.world_model_path={tmp_path / 'wm' / 'pretrained_model'} --steps=1",
            f"{TRAIN_FLAGS} --dataset.repo_id=test/faults --dataset.root={dataset} --output_dir={tmp_path / 'run'}",
        )
    assert not list(tmp_path.rglob("*.npy")), "images were decoded first"


BATCH = {"episode_index": torch.tensor([3, 0, 1, 3])}


def test_a_loss_that_is_not_finite_is_named() -> None:
    config = SimpleNamespace(lr=1e-3, dtype="float32")
    check_finite({"loss": 1.0, "root": 2.0}, config, BATCH)
    with pytest.raises(DivergenceError, match=r"root, loss .*episodes 0, 1, 3\b"):
        check_finite({"left": 1.0, "root": math.nan, "loss": math.inf}, config, BATCH)
    with pytest.raises(DivergenceError, match="loss"):
        check_finite({"loss": -math.inf}, config, {})


@pytest.mark.parametrize(
    ("settings", "advice", "bad_advice"),
    [
        ({"lr": 1e-3, "dtype": "bfloat16"}, ["--policy.lr", "--policy.dtype=float32"], "optimizer_lr"),
        ({"lr": 1e-3, "dtype": "float32"}, ["--policy.lr"], "dtype"),
        ({"optimizer_lr": 1e-3}, ["--policy.optimizer_lr"], "dtype"),
    ],
)
def test_advice_on_divergence_names_flags_of_the_policy(
    settings: dict, advice: list[str], bad_advice: str
) -> None:
    with pytest.raises(DivergenceError) as end:
        check_finite({"loss": math.nan}, SimpleNamespace(**settings), BATCH)
    assert all(flag in str(end.value) for flag in advice)
    assert bad_advice not in str(end.value)


def test_weights_that_are_not_finite_are_not_saved(dataset: Path, tmp_path: Path) -> None:
    """A gradient can be infinite where the loss is finite."""
    policy = make_policy(
        WMRSSMConfig(device="cpu", rssm=RSSMConfig(deter_dim=16, stoch_dim=8, hidden_dim=16)),
        ds_meta=LeRobotDatasetMetadata("test/faults", root=dataset),
    )
    check_finite_weights(policy, policy.config)
    name, weight = next(iter(policy.named_parameters()))
    with torch.no_grad():
        weight.view(-1)[0] = math.inf
    with pytest.raises(DivergenceError, match=name):
        policy.save_pretrained(tmp_path / "checkpoint")
    assert not list(tmp_path.rglob("*.safetensors"))
