"""`lerobot-wm train`: LeRobot's own training loop, fed from RAM or GPU memory instead of its DataLoader."""

import json
import logging
import os
from collections.abc import Iterator
from contextlib import contextmanager, nullcontext
from datetime import timedelta
from pathlib import Path
from typing import Any

from accelerate import Accelerator, DistributedDataParallelKwargs, InitProcessGroupKwargs
from accelerate.data_loader import BatchSamplerShard
from lerobot.configs import parser
from lerobot.configs.train import TrainPipelineConfig
from lerobot.datasets.dataset_metadata import LeRobotDatasetMetadata
from lerobot.scripts.lerobot_train import train as lerobot_train
from lerobot.utils.logging_utils import MetricsTracker
from torch import Tensor

from lerobot_wm.constants import OBS_LATENT
from lerobot_wm.data.check import check_dataset, damage_named
from lerobot_wm.data.loader import RamLoader
from lerobot_wm.data.lock import sole_writer
from lerobot_wm.hub.errors import check_can_push, check_dataset_version
from lerobot_wm.pipeline.divergence import LossWatch
from lerobot_wm.pipeline.encode import encode_to_cache
from lerobot_wm.pipeline.processors import check_policy_path, check_processors
from lerobot_wm.pipeline.train_resume import clear_unfinished, how_to_go_on, restore_last, stops_explained
from lerobot_wm.pipeline.training_run import check_run_settings, check_training_state
from lerobot_wm.policies.cameras import ImagePolicyConfig
from lerobot_wm.policies.fits import check_dataset_fits
from lerobot_wm.policies.latent_config import LatentPolicyConfig

TRAIN_LOG_NAME = "train_log.jsonl"

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
        self._loaders: list[RamLoader] = []  # that of the training data first

    def prepare_model(self, model: Any, *args: Any, **kwargs: Any) -> Any:
        """Prepare the policy as accelerate does, and watch its loss."""
        prepared = super().prepare_model(model, *args, **kwargs)
        self._watch.attach(prepared)
        return prepared

    def backward(self, loss: Tensor, **kwargs: Any) -> None:
        """Go backward as accelerate does, and stop the training where that gives no finite gradient.

        Raises:
            DivergenceError: The loss or its gradient is NaN or infinite; the weights are still those before the step.
        """
        super().backward(loss, **kwargs)
        if self.scaler is None:  # that of float16 skips such steps by itself
            last = Path(self._train_config.output_dir) / "checkpoints" / "last"
            self._watch.check(loss, self._loaders[0], last)

    def prepare_data_loader(self, data_loader: Any, *args: Any, **kwargs: Any) -> RamLoader:
        """Replace the loader by one that reads the same samples, this process's share of them, from memory.

        Step k of W processes reads batches kW to kW + W - 1 of the epoch, one each: together the batch of one process
        with a W times larger batch size. An epoch's last step is filled up with the epoch's first samples.
        """
        batch_sampler = data_loader.batch_sampler
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


class TrainLog(logging.Filter):
    """Writes the metrics LeRobot logs to `<output_dir>/train_log.jsonl`, one line per log step.

    It is a filter on the root logger, which LeRobot's `init_logging` leaves in place when it replaces handlers.
    """

    def __init__(self, output_dir: Path) -> None:
        super().__init__()
        self._path = output_dir / TRAIN_LOG_NAME

    def filter(self, record: logging.LogRecord) -> bool:
        """Note metrics in passing; every record goes through."""
        if isinstance(record.msg, MetricsTracker):
            self._path.parent.mkdir(parents=True, exist_ok=True)
            with self._path.open("a") as file:
                file.write(json.dumps({"step": record.msg.steps, **record.msg.to_dict()}) + "\n")
        return True


def cameras_to_serve(cfg: TrainPipelineConfig) -> dict[str, tuple[int, int]] | None:
    """The dataset's cameras that the policy looks at, and (H, W) it brings their images to.

    None, all of them as they are, where the policy is not one of ours.
    """
    policy = cfg.policy
    if not isinstance(policy, ImagePolicyConfig):
        return None
    names_in_dataset = {renamed: key for key, renamed in cfg.rename_map.items()}
    return {names_in_dataset.get(key, key): policy.image_size for key in policy.cameras}


def make_accelerator(cfg: TrainPipelineConfig) -> RamAccelerator:
    """The Accelerator LeRobot's train() would make for the policy of a run, with our loaders.

    Raises:
        RuntimeError: Several processes were asked for, and accelerate started one.
    """
    policy = cfg.policy
    # As in LeRobot: a policy's own `dtype` decides the precision, `use_amp` where it has none.
    dtype = getattr(policy, "dtype", "bfloat16" if policy.use_amp else "float32")
    accelerator = RamAccelerator(
        cfg,
        step_scheduler_with_optimizer=False,
        mixed_precision={"bfloat16": "bf16", "float16": "fp16"}.get(dtype, "no"),
        kwargs_handlers=[
            DistributedDataParallelKwargs(find_unused_parameters=True),
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


def encode_if_needed(cfg: TrainPipelineConfig) -> None:
    """Point a latent policy's training at latents, encoding an image dataset first, once, into its cache.

    Args:
        cfg: Changed in place: its dataset becomes the encoded one.

    Raises:
        ValueError: The policy and the dataset do not fit; nothing was encoded.
    """
    policy = cfg.policy
    if not isinstance(policy, ImagePolicyConfig):
        return
    meta = LeRobotDatasetMetadata(cfg.dataset.repo_id, root=cfg.dataset.root, revision=cfg.dataset.revision)
    check_dataset_fits(policy, meta, cfg.rename_map)
    if not isinstance(policy, LatentPolicyConfig) or not policy.use_latent:
        return
    encoder = policy.world_model_path
    if policy.pretrained_path is not None:  # trained on: its checkpoint holds the world model
        revision = f"@{policy.pretrained_revision}" if policy.pretrained_revision else ""
        encoder = f"{policy.pretrained_path}{revision}"
    if encoder is None:
        return
    if OBS_LATENT not in meta.features:
        encoded = encode_to_cache(encoder, cfg.dataset.repo_id, meta, str(policy.device))
        cfg.dataset.repo_id, cfg.dataset.root = f"{cfg.dataset.repo_id}_latents", str(encoded)
        cfg.dataset.revision = None


@parser.wrap()
def train(cfg: TrainPipelineConfig) -> None:
    """Train any LeRobot policy as `lerobot-train` does, from the same flags, into the same checkpoints."""
    if not cfg.resume and cfg.output_dir is not None and cfg.output_dir.exists():
        # While another process is at work there, nothing is to be gone on with, or to be removed.
        with sole_writer(cfg.output_dir):
            raise FileExistsError(
                f"{cfg.output_dir} is there already: choose another --output_dir, or {how_to_go_on(cfg.output_dir)}."
            )
    cfg.validate()
    if cfg.policy is None:
        raise ValueError(
            "lerobot-wm train trains policies (--policy.type=...); for reward models use lerobot-train."
        )
    if cfg.dataset.streaming:
        raise ValueError("--dataset.streaming=true reads no dataset into memory: use lerobot-train for it.")
    if cfg.policy.pretrained_path is not None:
        check_processors(cfg.policy.pretrained_path, cfg.policy.pretrained_revision)
    if cfg.resume:
        check_training_state(cfg.checkpoint_path)
    accelerator = make_accelerator(cfg)
    if cfg.policy.push_to_hub and accelerator.is_main_process:
        check_can_push(cfg.policy.repo_id)  # now, not when hours of training are over
    with (
        sole_writer(cfg.output_dir) if accelerator.is_main_process else nullcontext(),
        stops_explained(cfg.output_dir),
    ):
        _train(cfg, accelerator)


def _train(cfg: TrainPipelineConfig, accelerator: RamAccelerator) -> None:
    if cfg.resume and accelerator.is_main_process:
        clear_unfinished(cfg.checkpoint_path, cfg.output_dir)
    check_dataset(cfg.dataset.repo_id, cfg.dataset.root)
    check_dataset_version(cfg.dataset.repo_id, cfg.dataset.root, cfg.dataset.revision)
    with accelerator.in_turn():
        encode_if_needed(cfg)
    log = TrainLog(cfg.output_dir)
    logging.getLogger().addFilter(log)
    try:
        with damage_named(cfg.dataset.repo_id, cfg.dataset.root):
            lerobot_train(cfg, accelerator=accelerator)
    finally:
        logging.getLogger().removeFilter(log)


def main() -> None:
    """Entry point of `lerobot-wm train`."""
    config_path = parser.parse_arg("config_path")
    if config_path is not None:
        restore_last(config_path)
        check_run_settings(config_path)
    check_policy_path()
    train()
