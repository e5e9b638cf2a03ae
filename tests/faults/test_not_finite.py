"""NaN and Inf: in data they are refused where data is written or read, in training they stop it before the weights."""

import math
import shutil
from collections.abc import Callable
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import pytest
import torch
from lerobot.datasets.lerobot_dataset import LeRobotDataset
from lerobot_wm.train.accelerator import DivergenceError, LossWatch
from torch import nn
from torch.utils.data import DataLoader

from lerobot_wm.collect.shards import Shard, write_shard
from lerobot_wm.data.loader import RamDataset, RamLoader
from lerobot_wm.data.options import SourceConfig
from lerobot_wm.data.source import DatasetError
from lerobot_wm.envs.simulation import Simulation
from lerobot_wm.policies.wm_rssm.modeling_wm_rssm import WMRSSMPolicy
from tests.faults.breakage import DATA, set_value
from tests.flags import SMALL_WORLD_MODEL, TRAIN_FLAGS

CPU = torch.device("cpu")


@pytest.mark.parametrize(
    ("column", "value"),
    [("action", [math.nan, 0.0]), ("observation.state", [0.0, 0.0, math.inf]), ("next.reward", -math.inf)],
)
def test_data_is_refused_when_it_is_cached(column: str, value: Any, dataset: Path) -> None:
    set_value(dataset, DATA.format(1), column, row=3, value=value)
    expected = rf"{column} holds NaN or Inf in episode 1 \(task 'Push'\), frame 3"
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
        write_shard(shard, tmp_path, on_episode=lambda: None)
    assert not (tmp_path / shard.name).exists()


def train(run: Callable[..., None], dataset: Path, output_dir: Path, *flags: str) -> str:
    """The message that a training ends with."""
    with pytest.raises((DatasetError, DivergenceError)) as end:
        run(
            f"train --policy.type=wm_rssm --policy.window_length=4 --batch_size=4 {SMALL_WORLD_MODEL} {TRAIN_FLAGS}",
            "--policy.dtype=float32 --log_freq=1 --save_freq=1 --steps=6",
            f"--dataset.repo_id=test/faults --dataset.root={dataset} --output_dir={output_dir}",
            *flags,
        )
    return str(end.value)


def test_training_that_diverges_keeps_its_last_good_checkpoint(
    dataset: Path, tmp_path: Path, lerobot_wm_command: Callable[..., None]
) -> None:
    # The first step is taken from a finite loss, to weights of 1e30.
    line = train(lerobot_wm_command, dataset, tmp_path / "run", "--policy.lr=1e30")
    assert line.startswith("training diverged: the loss's part '")
    assert "is NaN or Inf on a batch of the episodes " in line
    assert "\n" not in line
    checkpoints = tmp_path / "run" / "checkpoints"
    assert sorted(path.name for path in checkpoints.iterdir()) == ["000001", "last"]
    assert f"the last checkpoint, {checkpoints / 'last'}, is whole" in line
    WMRSSMPolicy.from_pretrained(checkpoints / "last" / "pretrained_model")  # which refuses NaN


def test_training_on_broken_data_does_not_begin(
    dataset: Path, tmp_path: Path, lerobot_wm_command: Callable[..., None]
) -> None:
    set_value(dataset, DATA.format(2), "next.reward", row=1, value=math.nan)
    line = train(lerobot_wm_command, dataset, tmp_path / "run")
    assert "next.reward holds NaN or Inf in episode 2 (task 'Lift'), frame 1" in line
    assert not (tmp_path / "run" / "checkpoints").exists()


def test_a_policys_training_on_broken_data_encodes_nothing(
    dataset: Path, tmp_path: Path, lerobot_wm_command: Callable[..., None]
) -> None:
    lerobot_wm_command(
        f"init --policy.type=wm_rssm --policy.device=cpu {SMALL_WORLD_MODEL} --output_dir={tmp_path / 'wm'}",
        f"--dataset.repo_id=test/faults --dataset.root={dataset}",
    )
    set_value(dataset, DATA.format(2), "action", row=1, value=[0.0, math.nan])
    with pytest.raises(DatasetError, match=r"action holds NaN or Inf in episode 2 \(task 'Lift'\), frame 1"):
        lerobot_wm_command(
            f"train --policy.type=wm_bc --policy.world_model_path={tmp_path / 'wm' / 'pretrained_model'} --steps=1",
            f"{TRAIN_FLAGS} --dataset.repo_id=test/faults --dataset.root={dataset} --output_dir={tmp_path / 'run'}",
        )
    assert not list(tmp_path.rglob("*.npy")), "images were decoded first"


class Root(nn.Module):
    """Its loss is finite at a weight of 0, its gradient is not."""

    def __init__(self) -> None:
        super().__init__()
        self.weight = nn.Parameter(torch.zeros(()))

    def forward(self, offset: float) -> tuple[torch.Tensor, dict[str, float]]:
        loss = (self.weight + offset).sqrt()
        return loss, {"root": loss.item()}


def test_a_gradient_that_is_not_finite_is_named(whole_dataset: Path, tmp_path: Path) -> None:
    dataset = LeRobotDataset("test/faults", root=shutil.copytree(whole_dataset, tmp_path / "dataset"))
    loader = DataLoader(dataset, batch_sampler=[[0, 13, 14, 45]])
    served = RamLoader(loader, loader.batch_sampler, CPU, cameras={})
    next(iter(served))
    model, watch = Root(), LossWatch()
    watch.attach(model)
    for offset, broken in ((1.0, None), (0.0, "the gradient of weight"), (-1.0, "the loss's part 'root'")):
        model.zero_grad()
        loss, _ = model.forward(offset)
        loss.backward()
        if broken is None:
            watch.check(loss, served, tmp_path / "last")
            continue
        with pytest.raises(
            DivergenceError, match=f"{broken} is NaN or Inf on a batch of the episodes 0, 1, 3. .*none is"
        ):
            watch.check(loss, served, tmp_path / "last")
        own = (
            "on a batch of"
            if "part" in broken
            else "in one of 2 processes, of which this one was on a batch of"
        )
        with pytest.raises(DivergenceError, match=f"{broken} is NaN or Inf {own} the episodes 0, 1, 3. "):
            watch.check(loss, served, tmp_path / "last", 2)


@pytest.mark.parametrize(
    ("settings", "advice"),
    [
        ({"lr": 1e-3, "dtype": "bfloat16"}, "a lower --policy.lr, or train in --policy.dtype=float32."),
        ({"lr": 1e-3, "dtype": "float32"}, "a lower --policy.lr."),
        ({"optimizer_lr": 1e-3}, "a lower --policy.optimizer_lr."),
    ],
)
def test_advice_on_divergence_names_flags_of_the_policy(
    settings: dict, advice: str, whole_dataset: Path, tmp_path: Path
) -> None:
    dataset = LeRobotDataset("test/faults", root=whole_dataset)
    loader = DataLoader(dataset, batch_sampler=[[0]])
    served = RamLoader(loader, loader.batch_sampler, CPU, cameras={})
    next(iter(served))
    model, watch = Root(), LossWatch()
    model.config = SimpleNamespace(**settings)
    watch.attach(model)
    loss, _ = model.forward(-1.0)
    loss.backward()
    with pytest.raises(DivergenceError) as end:
        watch.check(loss, served, tmp_path / "last")
    assert str(end.value).endswith(f"Train again with {advice}")
