"""An Accelerator that hands LeRobot's training loop batches from RAM or GPU memory."""

import os
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from datetime import timedelta
from functools import wraps
from pathlib import Path
from typing import Any

import torch
from accelerate import Accelerator, DistributedDataParallelKwargs, InitProcessGroupKwargs
from accelerate.data_loader import BatchSamplerShard
from accelerate.utils import DistributedType
from lerobot.configs.train import TrainPipelineConfig
from torch import Tensor, nn
from torch.optim import Optimizer

from lerobot_wm.data.loader import RamLoader, batches_of_rows
from lerobot_wm.policies.common.cameras import ImagePolicyConfig
from lerobot_wm.policies.common.checks import check_environment_fits
from lerobot_wm.policies.common.features import names_before
from lerobot_wm.train.updates import Updates, updates_per_step


class DivergenceError(RuntimeError):
    """The loss or its gradient is NaN or infinite; its text is one line: which part of the loss, on which episodes."""


class LossWatch:
    """Looks at each step's loss and gradient, and remembers the loss's parts to name the one that is not finite."""

    def __init__(self) -> None:
        self._parts: dict[str, Any] = {}
        self._trained: list[tuple[str, nn.Parameter]] = []
        self._config: object = None

    def attach(self, model: nn.Module) -> None:
        """Follow a LeRobot policy, prepared for training; its `forward` returns the loss and its parts by name."""
        self._config = getattr(model, "config", None)
        self._trained = [
            (name, parameter) for name, parameter in model.named_parameters() if parameter.requires_grad
        ]
        model.forward = self._noting(model.forward)  # LeRobot calls it by name, past the hooks of modules

    def _noting(self, forward: Callable[..., Any]) -> Callable[..., Any]:
        @wraps(forward)
        def noted(*args: Any, **kwargs: Any) -> Any:
            loss, parts = forward(*args, **kwargs)
            self._parts = parts or {}
            return loss, parts

        return noted

    def check(self, loss: Tensor, served: RamLoader, last_checkpoint: Path, n_processes: int = 1) -> None:
        """Look at a step between its backward pass and the optimizer's.

        Processes that train together find a gradient that is not finite at the same step: they have averaged it.

        Args:
            loss: The scalar.
            served: The batch is the last it served.
            last_checkpoint: Where to go on from, if it is there.
            n_processes: How many train together.

        Raises:
            DivergenceError: The loss or a gradient is not finite.
        """
        gradients = [parameter.grad for _, parameter in self._trained if parameter.grad is not None]
        norm = torch.nn.utils.get_total_norm(gradients)
        if bool((loss.detach() + norm).isfinite()):
            return
        parts = ", ".join(self._broken_parts()) or f"the gradient of {next(self._broken_gradients(), 'all')}"
        where = f"on a batch of the episodes {', '.join(map(str, served.episodes))}"
        if n_processes > 1 and loss.isfinite():  # its own batch may be innocent
            where = f"in one of {n_processes} processes, of which this one was {where}"
        saved = (
            f"the last checkpoint, {last_checkpoint}, is whole"
            if last_checkpoint.exists()
            else "none is saved yet"
        )
        raise DivergenceError(
            f"training diverged: {parts} is NaN or Inf {where}. It reached no checkpoint; {saved}. "
            f"{self._mend(last_checkpoint.exists())}"
        )

    def _mend(self, can_go_on: bool) -> str:
        rates = [f"--policy.{name}" for name in ("lr", "optimizer_lr") if hasattr(self._config, name)]
        mend = f"Train again with a lower {(rates or ['learning rate'])[0]}"
        if getattr(self._config, "dtype", None) != "bfloat16":
            return f"{mend}."
        return f"{mend}, or {'go on' if can_go_on else 'train'} in --policy.dtype=float32."

    def _broken_parts(self) -> Iterator[str]:
        for name, value in self._parts.items():
            if isinstance(value, float) and not -float("inf") < value < float("inf"):
                yield f"the loss's part '{name}'"

    def _broken_gradients(self) -> Iterator[str]:
        for name, parameter in self._trained:
            if parameter.grad is not None and not parameter.grad.isfinite().all():
                yield name


# How long processes wait for the one that decodes or encodes; by default they give up after minutes.
_PATIENCE = timedelta(days=1)


class RamAccelerator(Accelerator):
    """An Accelerator whose data loaders serve LeRobot's batches from memory; everything else is accelerate's.

    Args:
        train_config: Of the run: names the policy, whose cameras alone are served.
        **kwargs: accelerate's own.
    """

    def __init__(self, train_config: TrainPipelineConfig, **kwargs: Any) -> None:
        super().__init__(**kwargs)
        self._train_config = train_config
        self._watch = LossWatch()
        self._updates: Updates | None = None
        self._loaders: list[RamLoader] = []  # that of the training data first

    def prepare_model(self, model: Any, *args: Any, **kwargs: Any) -> Any:
        """Prepare the policy as accelerate does, and watch its loss.

        Raises:
            ValueError: It cannot act in the environment that is to evaluate it.
        """
        cfg = self._train_config
        if cfg.env is not None and cfg.env_eval_freq > 0:  # now, not when the first evaluation is due
            check_environment_fits(cfg.policy, cfg.env, cfg.rename_map)
        prepared = super().prepare_model(model, *args, **kwargs)
        if (n := updates_per_step(cfg)) > 1:
            self._updates = Updates(prepared, cfg.batch_size // n, cfg.optimizer.grad_clip_norm)
        self._watch.attach(prepared)
        if self.distributed_type == DistributedType.NO:  # nothing exchanges them once training runs
            # LeRobot asks for them at every step, and a walk through a frozen world model takes longer than what
            # it does with a small policy's gradients.
            parameters = list(prepared.parameters())
            prepared.parameters = lambda: iter(parameters)
        return prepared

    def prepare_optimizer(self, optimizer: Optimizer, device_placement: bool | None = None) -> Any:
        """Prepare the optimizer as accelerate does, past whose wrapper it steps where that adds nothing.

        It searches the disk for the package of another optimizer twice a step: of a small policy's steps a tenth.
        """
        prepared = super().prepare_optimizer(optimizer, device_placement)
        if self.scaler is None:
            prepared.step, prepared.zero_grad = optimizer.step, optimizer.zero_grad
        if self._updates is not None:
            self._updates.optimizer = optimizer
        return prepared

    def unwrap_model(
        self, model: Any, keep_fp32_wrapper: bool = True, keep_torch_compile: bool = True
    ) -> Any:
        """Unwrap as accelerate does, without its walk through all modules where nothing can be wrapped.

        LeRobot unwraps the policy at every step.
        """
        if self.distributed_type == DistributedType.NO and keep_fp32_wrapper and keep_torch_compile:
            return model
        return super().unwrap_model(model, keep_fp32_wrapper, keep_torch_compile)

    def backward(self, loss: Tensor, **kwargs: Any) -> None:
        """Go backward as accelerate does, and stop the training where that gives no finite gradient.

        Raises:
            DivergenceError: The loss or its gradient is NaN or infinite.
        """
        super().backward(loss, **kwargs)
        if self.scaler is None:  # that of float16 skips such steps by itself
            last = Path(self._train_config.output_dir) / "checkpoints" / "last"
            self._watch.check(loss, self._loaders[0], last, self.num_processes)

    def prepare_data_loader(self, data_loader: Any, *args: Any, **kwargs: Any) -> RamLoader:
        """Replace the loader by one that reads the same samples, this process's share of them, from memory.

        Step k of W processes reads batches kW to kW + W - 1 of the epoch, one each: together the batch of one process
        with a W times larger batch size. An epoch's last step is filled up with the epoch's first samples, also where a
        step's batch is shared by several updates.
        """
        batch_sampler = batches_of_rows(data_loader, fill=updates_per_step(self._train_config) > 1)
        if self.num_processes > 1:
            batch_sampler = BatchSamplerShard(batch_sampler, self.num_processes, self.process_index)
        with self.in_turn():  # the first decodes the frames, the others map them
            loader = RamLoader(data_loader, batch_sampler, self.device, cameras_to_serve(self._train_config))
        self._loaders.append(loader)
        return loader

    @contextmanager
    def in_turn(self) -> Iterator[None]:
        """Let one process make files that the others then find there.

        The main process goes first, then the first of each other host, whose disk may be its own, then the rest.
        """
        turn = 0 if self.is_main_process else 1 if self.is_local_main_process else 2
        for _ in range(turn):
            self.wait_for_everyone()
        yield
        for _ in range(turn, 2):
            self.wait_for_everyone()


def cameras_to_serve(cfg: TrainPipelineConfig) -> dict[str, tuple[int, int]] | None:
    """The dataset's cameras that the policy looks at, and (H, W) it brings their images to.

    None, all of them as they are, where the policy is not one of ours.
    """
    policy = cfg.policy
    if not isinstance(policy, ImagePolicyConfig):
        return None
    cameras = names_before(policy.cameras, cfg.rename_map)
    return dict.fromkeys(cameras, policy.image_size) if cameras else {}  # without one there is no size


def make_accelerator(cfg: TrainPipelineConfig) -> RamAccelerator:
    """The Accelerator LeRobot's train() would make for the policy of a run, with our loaders.

    Raises:
        RuntimeError: Several processes were asked for, and accelerate started one.
    """
    policy = cfg.policy
    device = torch.device(policy.device)
    if device.type == "cuda" and device.index is not None and "LOCAL_RANK" not in os.environ:
        torch.cuda.set_device(device)  # where accelerate was not told by a launcher it takes the current one
    # As in LeRobot: a policy's own `dtype` decides the precision; where it has none `use_amp`, or the launcher.
    amp_dtype = torch.get_autocast_dtype(device.type) if policy.use_amp else None
    dtype = str(getattr(policy, "dtype", amp_dtype)).removeprefix("torch.")
    accelerator = RamAccelerator(
        cfg,
        step_scheduler_with_optimizer=False,
        mixed_precision={"bfloat16": "bf16", "float16": "fp16", "float32": "no"}.get(dtype),
        kwargs_handlers=[
            # Buffers of our policies are alike in all processes: one of a number per frame of the dataset would be sent
            # around at every step.
            DistributedDataParallelKwargs(
                find_unused_parameters=True, broadcast_buffers=not isinstance(policy, ImagePolicyConfig)
            ),
            InitProcessGroupKwargs(timeout=_PATIENCE),
        ],
        cpu=policy.device == "cpu",
    )
    # Without GPUs accelerate has no launcher for several processes, but this is what it sets where they were asked for.
    launched = {"ACCELERATE_USE_CPU", "MASTER_ADDR"} <= os.environ.keys()
    if launched and accelerator.device.type == "cpu" and accelerator.num_processes == 1:
        raise RuntimeError(
            "accelerate launch was asked for several processes on CPUs and started one, which would train on a smaller "
            "batch than was meant. torchrun starts them: "
            "torchrun --nproc_per_node=2 -m lerobot_wm.cli train --policy.device=cpu ..."
        )
    return accelerator
