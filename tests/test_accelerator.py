from pathlib import Path

import pytest
import torch
from accelerate import Accelerator
from accelerate.state import AcceleratorState
from lerobot.configs import PreTrainedConfig
from lerobot.configs.default import DatasetConfig
from lerobot.configs.train import TrainPipelineConfig
from lerobot.policies.act.configuration_act import ACTConfig
from lerobot_wm.train.accelerator import RamAccelerator, make_accelerator
from torch import Tensor, nn

from lerobot_wm.policies.e2e_bc.configuration_e2e_bc import E2EBCConfig


class Line(nn.Module):
    def __init__(self) -> None:
        super().__init__()
        self.slope = nn.Parameter(torch.ones(()))

    def forward(self, x: Tensor) -> tuple[Tensor, dict[str, float]]:
        return (self.slope * x).square(), {}


@pytest.fixture
def accelerator(tmp_path: Path) -> RamAccelerator:
    policy = E2EBCConfig(device="cpu", dtype="float32", push_to_hub=False)
    return make_accelerator(
        TrainPipelineConfig(DatasetConfig("test/demos"), policy=policy, output_dir=tmp_path)
    )


def test_a_step_is_the_optimizers_own(accelerator: RamAccelerator, monkeypatch: pytest.MonkeyPatch) -> None:
    def search() -> bool:
        raise AssertionError("a step searches the disk")

    model = Line()
    optimizer = torch.optim.SGD(model.parameters(), lr=0.1)
    schedule = torch.optim.lr_scheduler.LambdaLR(optimizer, lambda step: 0.5**step)
    prepared, stepper, scheduler = accelerator.prepare(model, optimizer, schedule)
    monkeypatch.setattr("accelerate.optimizer.is_lomo_available", search)
    for rate, slope in ((0.1, 0.8), (0.05, 0.72)):
        assert stepper.param_groups[0]["lr"] == rate
        prepared.forward(torch.ones(()))[0].backward()
        stepper.step()
        stepper.zero_grad()
        scheduler.step()
        assert model.slope.item() == pytest.approx(slope)
        assert model.slope.grad is None


def test_the_gpu_is_the_one_that_was_named(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """Accelerate takes the current one, and evaluation the one that was named."""
    chosen = []
    policy = E2EBCConfig(device="cpu", dtype="float32", push_to_hub=False)
    cfg = TrainPipelineConfig(DatasetConfig("test/demos"), policy=policy, output_dir=tmp_path)
    monkeypatch.setattr(torch.cuda, "set_device", chosen.append)
    for device in ("cuda:1", "cuda", "cpu"):
        policy.device = device
        AcceleratorState._reset_state(reset_partial_state=True)
        make_accelerator(cfg)
    AcceleratorState._reset_state(reset_partial_state=True)
    assert chosen == [torch.device("cuda:1")]


def test_a_step_walks_through_no_modules(
    accelerator: RamAccelerator, monkeypatch: pytest.MonkeyPatch
) -> None:
    """LeRobot asks for the parameters at every step, those of a frozen world model among them."""
    model = nn.Sequential(Line(), Line())
    expected = list(model.parameters())
    prepared = accelerator.prepare(model)
    monkeypatch.setattr(nn.Module, "named_modules", lambda *_, **__: pytest.fail("a walk"))
    for _ in range(2):
        assert [id(each) for each in prepared.parameters()] == [id(each) for each in expected]


def test_unwrapping_gives_what_accelerate_gives(accelerator: RamAccelerator) -> None:
    prepared = accelerator.prepare(Line())
    assert accelerator.unwrap_model(prepared) is Accelerator.unwrap_model(accelerator, prepared)


@pytest.mark.parametrize(
    ("policy", "launched_with", "expected"),
    [
        (ACTConfig(device="cpu", use_amp=True), None, "bf16"),
        (ACTConfig(device="cpu"), None, "no"),
        (ACTConfig(device="cpu"), "bf16", "bf16"),
        (E2EBCConfig(device="cpu", dtype="float32"), "bf16", "no"),
    ],
)
def test_the_precision_is_lerobots(
    policy: PreTrainedConfig,
    launched_with: str | None,
    expected: str,
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    if launched_with is not None:
        monkeypatch.setenv("ACCELERATE_MIXED_PRECISION", launched_with)
    AcceleratorState._reset_state(reset_partial_state=True)
    cfg = TrainPipelineConfig(DatasetConfig("test/demos"), policy=policy, output_dir=tmp_path)
    assert make_accelerator(cfg).mixed_precision == expected
    AcceleratorState._reset_state(reset_partial_state=True)


@pytest.mark.parametrize(
    ("policy", "sends"), [(ACTConfig(device="cpu"), True), (E2EBCConfig(device="cpu"), False)]
)
def test_buffers_are_sent_around_where_processes_may_differ_in_them(
    policy: PreTrainedConfig, sends: bool, tmp_path: Path
) -> None:
    """Ours are alike, and one can be as long as the dataset."""
    cfg = TrainPipelineConfig(DatasetConfig("test/demos"), policy=policy, output_dir=tmp_path)
    assert make_accelerator(cfg).ddp_handler.broadcast_buffers is sends
