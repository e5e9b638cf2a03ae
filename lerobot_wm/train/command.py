"""`lerobot-wm train`: LeRobot's own training loop, fed from RAM or GPU memory instead of its DataLoader."""

import json
import logging
from contextlib import nullcontext
from pathlib import Path

from lerobot.configs import PreTrainedConfig, parser
from lerobot.configs.train import TrainPipelineConfig
from lerobot.datasets.dataset_metadata import LeRobotDatasetMetadata
from lerobot.scripts.lerobot_train import train as lerobot_train
from lerobot.utils.constants import PRETRAINED_MODEL_DIR
from lerobot.utils.logging_utils import MetricsTracker

from lerobot_wm.constants import OBS_LATENT, TRAIN_LOG_NAME
from lerobot_wm.data.check import check_dataset, damage_named
from lerobot_wm.encode.command import LATENTS_PREFIX, encode_to_cache
from lerobot_wm.files import sole_writer
from lerobot_wm.hub.errors import check_can_push, check_dataset_version
from lerobot_wm.policies.common.cameras import ImagePolicyConfig
from lerobot_wm.policies.common.checkpoint import check_policy_path, check_processors, read_config
from lerobot_wm.policies.common.checks import check_dataset_fits
from lerobot_wm.policies.common.fine_tuning import names_given_by
from lerobot_wm.policies.latent.config import LatentPolicyConfig
from lerobot_wm.policies.world_model.config import WorldModelConfig
from lerobot_wm.system import keep_freed_memory
from lerobot_wm.train.accelerator import RamAccelerator, make_accelerator
from lerobot_wm.train.resume import (
    check_run_settings,
    check_training_state,
    clear_unfinished,
    how_to_go_on,
    restore_last,
    stops_explained,
)
from lerobot_wm.train.updates import check_updates


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
        encoded = encode_to_cache(encoder, cfg.dataset.repo_id, meta, str(policy.device), cfg.rename_map)
        cfg.dataset.repo_id, cfg.dataset.root = f"{cfg.dataset.repo_id}_latents", str(encoded)
        cfg.dataset.revision = None


def check_latents_are_there(cfg: TrainPipelineConfig) -> None:
    """Refuse to go on with a training whose encoded dataset was removed from the cache.

    Raises:
        FileNotFoundError: It is gone; names the command that makes it again.
    """
    root = Path(cfg.dataset.root or ".")
    if root.exists() or not root.name.startswith(LATENTS_PREFIX):
        return
    rename_map = f" --rename_map='{json.dumps(cfg.rename_map)}'" if cfg.rename_map else ""
    raise FileNotFoundError(
        f"{root} is gone, the latents that this training reads. To go on, make them again: lerobot-wm encode "
        f"--world_model_path={cfg.checkpoint_path / PRETRAINED_MODEL_DIR} --dataset.repo_id=... --dataset.root=... "
        f"--output_repo_id={cfg.dataset.repo_id} --output_root={root}{rename_map}, with the dataset of images as "
        "--dataset."
    )


def check_base_is_kept(policy: PreTrainedConfig) -> None:
    """Refuse to publish a policy in the place of the one it is trained on from, whose `repo_id` it has taken over.

    Raises:
        ValueError: It would go there.
    """
    base = read_config(policy.pretrained_path, policy.pretrained_revision)
    if policy.repo_id in (base.repo_id, str(policy.pretrained_path)):
        raise ValueError(
            f"--policy.repo_id={policy.repo_id} is where the policy of --policy.path is published, which this training "
            "would replace. Give another --policy.repo_id, or --policy.push_to_hub=false."
        )


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
    if cfg.job.is_remote:
        raise ValueError(
            f"--job.target={cfg.job.target}: lerobot-wm train trains on this machine, and a job would run "
            "lerobot-train without this package. Leave the flag out."
        )
    if cfg.sample_weighting is not None and isinstance(cfg.policy, ImagePolicyConfig):
        raise ValueError(
            f"--sample_weighting.type={cfg.sample_weighting.type}: {cfg.policy.type} has one loss for a batch, whose "
            "samples cannot be weighed. Leave the flag out."
        )
    if isinstance(cfg.policy, WorldModelConfig) and cfg.env is not None and cfg.env_eval_freq > 0:
        raise ValueError(
            f"--env.type={cfg.env.type}: {cfg.policy.type} makes latents and chooses no actions, so that no "
            "environment can evaluate it. Leave the flag out, or set --env_eval_freq=0, and evaluate a policy on its "
            "latents, --policy.type=wm_bc or wm_iql."
        )
    if cfg.policy.pretrained_path is not None:
        check_processors(cfg.policy.pretrained_path, cfg.policy.pretrained_revision)
        if cfg.policy.push_to_hub and not cfg.resume:
            check_base_is_kept(cfg.policy)
    if cfg.resume:
        check_training_state(cfg.checkpoint_path)
    accelerator = make_accelerator(cfg)
    check_updates(cfg, accelerator.num_processes)
    if cfg.policy.push_to_hub and accelerator.is_main_process:
        check_can_push(cfg.policy.repo_id)  # now, not when hours of training are over
    with (
        sole_writer(cfg.output_dir) if accelerator.is_main_process else nullcontext(),
        stops_explained(cfg.output_dir),
    ):
        _train(cfg, accelerator)


def _train(cfg: TrainPipelineConfig, accelerator: RamAccelerator) -> None:
    if cfg.resume:
        check_latents_are_there(cfg)
    if cfg.resume and accelerator.is_main_process:
        clear_unfinished(cfg.checkpoint_path, cfg.output_dir)
    check_dataset(cfg.dataset.repo_id, cfg.dataset.root, cfg.dataset.revision)
    check_dataset_version(cfg.dataset.repo_id, cfg.dataset.root, cfg.dataset.revision)
    with accelerator.in_turn():
        encode_if_needed(cfg)
    log = TrainLog(cfg.output_dir)
    logging.getLogger().addFilter(log)
    try:
        named = damage_named(cfg.dataset.repo_id, cfg.dataset.root, cfg.dataset.revision)
        with named, names_given_by(cfg.rename_map):
            lerobot_train(cfg, accelerator=accelerator)
    finally:
        logging.getLogger().removeFilter(log)


def _check_resumes_into_a_folder(config_path: str) -> None:
    # LeRobot names a folder by the time at each of several looks, and would leave the run's files in two.
    resume = (parser.parse_arg("resume") or "false").lower() in ("true", "yes", "on", "1")
    if resume and not Path(config_path).exists() and parser.parse_arg("output_dir") is None:
        raise ValueError(
            f"--config_path={config_path} is no file or folder here: to go on with a training of the Hub, name a "
            "folder for it by --output_dir."
        )


def main() -> None:
    """Entry point of `lerobot-wm train`."""
    config_path = parser.parse_arg("config_path")
    if config_path is not None:
        restore_last(config_path)
        check_run_settings(config_path)
        _check_resumes_into_a_folder(config_path)
    check_policy_path()
    keep_freed_memory()
    train()
