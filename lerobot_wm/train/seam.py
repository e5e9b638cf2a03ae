"""The one place that knows how batches from memory get into LeRobot's own `train()`.

LeRobot 0.6.1 takes an Accelerator, to which it hands its data loaders. Later versions make their own, and make their
data loaders in a function of their training script, `make_dataloaders`.
"""

import os
from datetime import timedelta
from typing import Any

import torch
from accelerate import Accelerator, DistributedDataParallelKwargs, PartialState
from accelerate.data_loader import BatchSamplerShard
from lerobot.configs import PreTrainedConfig
from lerobot.configs.train import TrainPipelineConfig
from lerobot.datasets.dataset_metadata import LeRobotDatasetMetadata
from lerobot.scripts import lerobot_train
from torch.optim import Optimizer
from torch.utils.data import DataLoader

from lerobot_wm.data.loader import RamLoader, batches_of_rows
from lerobot_wm.policies.common.card import TrainingData, model_card
from lerobot_wm.policies.common.checks import check_fit
from lerobot_wm.policies.common.config import PolicyConfig
from lerobot_wm.policies.common.features import names_before

# How long processes wait for the one that decodes or encodes. The default is minutes.
_PATIENCE = timedelta(days=1)


def train_from_memory(cfg: TrainPipelineConfig) -> None:
    """Run LeRobot's `train()` on batches from RAM or GPU memory."""
    if not hasattr(lerobot_train, "make_dataloaders"):  # LeRobot 0.6.1
        lerobot_train.train(cfg, accelerator=_make_accelerator(cfg))
        return
    if isinstance(cfg.policy, PolicyConfig):  # on LeRobot 0.6.1 a policy's dtype decides
        cfg.accelerator.mixed_precision = _mixed_precision(cfg.policy)
    make_dataloaders = lerobot_train.make_dataloaders

    def make_loaders_from_memory(*args: Any, **kwargs: Any) -> tuple[RamLoader | None, ...]:
        _check_environment(cfg)
        loaders = make_dataloaders(*args, **kwargs)
        return tuple(None if loader is None else serve_from_memory(loader, cfg) for loader in loaders)

    lerobot_train.make_dataloaders = make_loaders_from_memory
    try:
        lerobot_train.train(cfg)
    finally:
        lerobot_train.make_dataloaders = make_dataloaders
    if isinstance(cfg.policy, PolicyConfig) and cfg.policy.push_to_hub and PartialState().is_main_process:
        _publish_card(cfg, cfg.policy)


def start_processes(policy: PreTrainedConfig) -> PartialState:
    """Connect this process with those it trains together with, on the device that the policy names."""
    device = torch.device(policy.device)
    if device.type == "cuda" and device.index is not None and "LOCAL_RANK" not in os.environ:
        torch.cuda.set_device(device)  # accelerate takes the current one
    return PartialState(cpu=device.type == "cpu", timeout=_PATIENCE)


def serve_from_memory(data_loader: DataLoader, cfg: TrainPipelineConfig) -> RamLoader:
    """Replace a loader by one that reads the same samples, this process's share of them, from memory.

    Step k of W processes reads batches kW to kW + W - 1 of the epoch, one each: together the batch of one process with
    a W times larger batch size. An epoch's last step is filled up with the epoch's first samples.
    """
    processes = PartialState()
    batch_sampler = batches_of_rows(data_loader)
    if processes.num_processes > 1:
        batch_sampler = BatchSamplerShard(batch_sampler, processes.num_processes, processes.process_index)
    # One process of each machine decodes the frames, the others map them.
    with processes.main_process_first(), processes.local_main_process_first():
        return RamLoader(data_loader, batch_sampler, processes.device, cameras_to_serve(cfg))


def cameras_to_serve(cfg: TrainPipelineConfig) -> dict[str, tuple[int, int]] | None:
    """The dataset's cameras that the policy looks at, and (H, W) it brings their images to.

    None, all of them as they are, where the policy is not one of ours.
    """
    policy = cfg.policy
    if not isinstance(policy, PolicyConfig):
        return None
    cameras = names_before(policy.cameras, cfg.rename_map)
    return dict.fromkeys(cameras, policy.image_size) if cameras else {}  # without one there is no size


class _RamAccelerator(Accelerator):
    """accelerate's Accelerator, except that it prepares data loaders by serving their batches from memory."""

    def __init__(self, train_config: TrainPipelineConfig, **kwargs: Any) -> None:
        super().__init__(**kwargs)
        self._train_config = train_config

    def prepare(self, *objects: Any, **kwargs: Any) -> Any:
        _check_environment(self._train_config)
        served = (
            serve_from_memory(each, self._train_config) if isinstance(each, DataLoader) else each
            for each in objects
        )
        return super().prepare(*served, **kwargs)

    def prepare_optimizer(self, optimizer: Optimizer, device_placement: bool | None = None) -> Any:
        # accelerate's wrapper searches the disk for another optimizer's package at every step: a tenth of the time of a
        # small policy's. It is needed for float16 alone.
        return optimizer if self.scaler is None else super().prepare_optimizer(optimizer, device_placement)


def _make_accelerator(cfg: TrainPipelineConfig) -> Accelerator:
    """As LeRobot 0.6.1 makes it, but for the data loaders."""
    # Buffers of our policies are alike in all processes: one of a number per frame of the dataset would be sent around
    # at every step.
    buffers_differ = not isinstance(cfg.policy, PolicyConfig)
    return _RamAccelerator(
        cfg,
        step_scheduler_with_optimizer=False,
        mixed_precision=_mixed_precision(cfg.policy),
        kwargs_handlers=[
            DistributedDataParallelKwargs(find_unused_parameters=True, broadcast_buffers=buffers_differ)
        ],
        cpu=cfg.policy.device == "cpu",
    )


def _mixed_precision(policy: PreTrainedConfig) -> str | None:
    """accelerate's name for a policy's precision, as LeRobot 0.6.1 chooses it: `dtype`, or else `use_amp`."""
    amp_dtype = torch.get_autocast_dtype(torch.device(policy.device).type) if policy.use_amp else None
    dtype = str(getattr(policy, "dtype", amp_dtype)).removeprefix("torch.")
    return {"bfloat16": "bf16", "float16": "fp16", "float32": "no"}.get(dtype)


def _check_environment(cfg: TrainPipelineConfig) -> None:
    # LeRobot has made the policy by now. Without this the run would stop at its first evaluation.
    if cfg.env is not None and cfg.env_eval_freq > 0:
        check_fit(cfg.policy, cfg.env, cfg.rename_map)


def _publish_card(cfg: TrainPipelineConfig, policy: PolicyConfig) -> None:
    """Replace the card that LeRobot publishes; LeRobot 0.6.1 asks the policy for one."""
    meta = LeRobotDatasetMetadata(cfg.dataset.repo_id, root=cfg.dataset.root, revision=cfg.dataset.revision)
    card = model_card(policy, policy.repo_id, cfg, TrainingData.of(meta))
    card.push_to_hub(policy.repo_id)
