"""`lerobot-wm train`: LeRobot's own training loop, fed from RAM or GPU memory instead of its DataLoader."""

import json
import logging
import re
import sys
from collections.abc import Iterator
from contextlib import contextmanager, nullcontext
from copy import deepcopy
from dataclasses import asdict
from pathlib import Path

from lerobot.configs import FeatureType, PreTrainedConfig, parser
from lerobot.configs.train import TrainPipelineConfig
from lerobot.datasets.dataset_metadata import LeRobotDatasetMetadata
from lerobot.utils.constants import PRETRAINED_MODEL_DIR
from lerobot.utils.logging_utils import MetricsTracker

from lerobot_wm.constants import OBS_LATENT, TRAIN_LOG_NAME
from lerobot_wm.data.check import DatasetError
from lerobot_wm.data.source import damaged_tables_named, open_dataset
from lerobot_wm.encode.dataset import LATENTS_PREFIX, encode_to_cache
from lerobot_wm.errors import check_can_push
from lerobot_wm.files import sole_writer
from lerobot_wm.policies.common.checkpoint import open_checkpoint, read_config, read_json
from lerobot_wm.policies.common.checks import check_fit, check_reads, dataset_cameras, rename_command
from lerobot_wm.policies.common.config import PolicyConfig
from lerobot_wm.policies.common.features import names_given_by, policy_features
from lerobot_wm.policies.common.tasks import only_episodes
from lerobot_wm.policies.latent.config import LatentPolicyConfig, open_world_model
from lerobot_wm.system import keep_freed_memory
from lerobot_wm.train.flags import (
    check_episodes,
    check_flags,
    check_login,
    flag_names,
    write_beside_checkpoint,
)
from lerobot_wm.train.resume import clear_unfinished, explain_how_to_resume, restore_last, settings_in
from lerobot_wm.train.seam import start_processes, train_from_memory

# What LeRobot logs every `--eval_steps` steps.
_EVAL_LOSS = re.compile(r"step (\d+): eval_loss=(\S+)")


@contextmanager
def train_log(output_dir: Path) -> Iterator[None]:
    """Write what LeRobot logs to `<output_dir>/train_log.jsonl`, a line per log step and a line per held-out loss."""

    def note(record: logging.LogRecord) -> bool:
        line: dict[str, float] | None = None
        if isinstance(record.msg, MetricsTracker):
            line = {"step": record.msg.steps, **record.msg.to_dict()}
        elif found := _EVAL_LOSS.fullmatch(record.getMessage()):
            line = {"step": int(found[1]), "eval_loss": float(found[2])}
        if line is not None:
            output_dir.mkdir(parents=True, exist_ok=True)
            with (output_dir / TRAIN_LOG_NAME).open("a") as file:
                file.write(json.dumps(line) + "\n")
        return True

    # A filter: LeRobot's `init_logging` replaces the root logger's handlers.
    logger = logging.getLogger()
    logger.addFilter(note)
    try:
        yield
    finally:
        logger.removeFilter(note)


def open_dataset_and_encode(cfg: TrainPipelineConfig) -> None:
    """Check the dataset; for a policy on latents, encode an image dataset into its cache and train on that.

    Args:
        cfg: Changed in place: its dataset becomes the encoded one.

    Raises:
        ValueError: The dataset is damaged, or does not fit the policy; nothing was encoded.
    """
    policy = cfg.policy
    where = (cfg.dataset.repo_id, cfg.dataset.root, cfg.dataset.revision)
    meta = open_dataset(*where, cfg.dataset.episodes)
    check_episodes(cfg, meta)
    if not isinstance(policy, PolicyConfig):
        return
    check_fit(policy, meta, cfg.rename_map)
    if (
        not isinstance(policy, LatentPolicyConfig)
        or not policy.reads_stored_latents
        or OBS_LATENT in meta.features
    ):
        return
    if policy.pretrained_path is None:
        check_new_policy(policy, meta, cfg)
    encoder = policy.world_model_path
    if policy.pretrained_path is not None:  # its checkpoint holds the world model
        revision = f"@{policy.pretrained_revision}" if policy.pretrained_revision else ""
        encoder = f"{policy.pretrained_path}{revision}"
    if encoder is not None:
        if cfg.dataset.episodes is not None:
            check_all_episodes_are_there(cfg, meta)
        encoded = encode_to_cache(
            encoder, cfg.dataset.repo_id, meta, str(policy.device), cfg.rename_map, policy.latent_kind
        )
        cfg.dataset.repo_id, cfg.dataset.root = f"{cfg.dataset.repo_id}_latents", str(encoded)
        cfg.dataset.revision = None


def check_all_episodes_are_there(cfg: TrainPipelineConfig, meta: LeRobotDatasetMetadata) -> None:
    """Check that a dataset of which some episodes are chosen can be encoded: all of them are.

    Raises:
        DatasetError: Files of other episodes are missing.
    """
    try:
        open_dataset(cfg.dataset.repo_id, cfg.dataset.root, cfg.dataset.revision)
    except DatasetError as error:
        raise DatasetError(
            f"A policy on latents encodes all {meta.total_episodes} episodes, not only --dataset.episodes="
            f"{cfg.dataset.episodes}: {error} Or train one that reads the images of these episodes alone: wm_bc with "
            "--policy.finetune_world_model=true, or e2e_bc."
        ) from error


def check_new_policy(
    policy: LatentPolicyConfig, meta: LeRobotDatasetMetadata, cfg: TrainPipelineConfig
) -> None:
    """Check the settings of a new policy on latents against its world model and its evaluation, as LeRobot makes it.

    Raises:
        ValueError: They do not fit, which would be found out once the dataset is encoded.
    """
    trial, features = deepcopy(policy), policy_features(meta)
    trial.output_features = {key: each for key, each in features.items() if each.type is FeatureType.ACTION}
    trial.input_features = {key: each for key, each in features.items() if key not in trial.output_features}
    if policy.world_model_path is not None:
        check_reads(open_world_model(policy.world_model_path), meta)
    trial.fill_from_dataset(meta)
    trial.validate_features()
    if cfg.env is not None and cfg.env_eval_freq > 0:
        trial.input_features |= dataset_cameras(trial, meta)
        check_fit(trial, cfg.env)


def check_latents_are_there(cfg: TrainPipelineConfig) -> None:
    """Check that a run's encoded dataset is still in the cache when the run is resumed.

    Raises:
        FileNotFoundError: It is not; names the command that makes it again.
    """
    root = Path(cfg.dataset.root or ".")
    if root.exists() or not root.name.startswith(LATENTS_PREFIX):
        return
    others = f" --rename_map='{json.dumps(cfg.rename_map)}'" if cfg.rename_map else ""
    for name, value in asdict(cfg.policy.latent_kind).items():
        others += f" --{name}={value}"
    raise FileNotFoundError(
        f"Latents not found at {root}. To create them again, encode the image dataset: lerobot-wm encode "
        f"--world_model_path={cfg.checkpoint_path / PRETRAINED_MODEL_DIR} --dataset.repo_id=... --dataset.root=... "
        f"--output_repo_id={cfg.dataset.repo_id} --output_root={root}{others}"
    )


def check_base_is_kept(policy: PreTrainedConfig) -> None:
    """Check that a fine-tuned policy is not published over its base, whose `repo_id` it takes over.

    Raises:
        ValueError: It would be.
    """
    base = read_config(policy.pretrained_path, policy.pretrained_revision)
    if policy.repo_id in (base.repo_id, str(policy.pretrained_path)):
        raise ValueError(
            f"--policy.repo_id={policy.repo_id} is where the policy of --policy.path is published, and this run would "
            "replace it. Give another --policy.repo_id, or --policy.push_to_hub=false."
        )


@parser.wrap()
def train(cfg: TrainPipelineConfig) -> None:
    """Train any LeRobot policy as `lerobot-train` does, from the same flags, into the same checkpoints."""
    is_new = cfg.policy is not None and cfg.policy.pretrained_path is None and not cfg.resume
    if cfg.rename_map and is_new and parser.get_path_arg("policy") is None:
        raise ValueError(
            "--rename_map gives a dataset the names that a checkpoint was trained with (--policy.path). A new policy "
            "takes the dataset's own names; to change these, make a copy: "
            f"{rename_command(cfg.dataset.repo_id, cfg.dataset.root, cfg.rename_map)}"
        )
    cfg.validate()
    given = flag_names(sys.argv[1:])
    if cfg.policy is None or cfg.dataset.streaming or cfg.job.is_remote:
        raise ValueError(
            "lerobot-wm train trains a policy on this machine, on a dataset that it reads into memory. For reward "
            "models, --dataset.streaming=true and --job.target use lerobot-train."
        )
    check_flags(cfg, given)
    write_beside_checkpoint(cfg, given)
    if cfg.policy.pretrained_path is not None:
        open_checkpoint(cfg.policy.pretrained_path, cfg.policy.pretrained_revision)
        if cfg.policy.push_to_hub and not cfg.resume:
            check_base_is_kept(cfg.policy)
    processes = start_processes(cfg.policy)
    if processes.is_main_process:  # now, not when hours of training are over
        if cfg.policy.push_to_hub or cfg.save_checkpoint_to_hub:
            check_can_push(cfg.policy.repo_id)
        check_login(cfg)
    with (
        only_episodes(cfg.dataset.episodes),
        sole_writer(cfg.output_dir) if processes.is_main_process else nullcontext(),
        explain_how_to_resume(cfg.output_dir),
    ):
        if cfg.resume:
            check_latents_are_there(cfg)
            if processes.is_main_process:
                clear_unfinished(cfg.checkpoint_path, cfg.output_dir)
        # One process of each machine downloads and encodes, the others find it done.
        with processes.main_process_first(), processes.local_main_process_first():
            open_dataset_and_encode(cfg)
        with (
            train_log(cfg.output_dir),
            damaged_tables_named(cfg.dataset.repo_id, cfg.dataset.root, cfg.dataset.revision),
            names_given_by(cfg.rename_map),
        ):
            train_from_memory(cfg)


def main() -> None:
    """Entry point of `lerobot-wm train`."""
    config_path = parser.parse_arg("config_path")
    if config_path is not None:
        settings = settings_in(Path(config_path))
        restore_last(settings)
        if settings.is_file():
            read_json(settings)
            # LeRobot's parser reads sys.argv.
            others = parser.filter_arg("config_path", sys.argv[1:])
            sys.argv = [sys.argv[0], f"--config_path={settings}", *others]
    path = parser.get_path_arg("policy")
    if path:  # before LeRobot's parser reads it, which would show a traceback
        open_checkpoint(path, parser.parse_arg("policy.pretrained_revision"))
    keep_freed_memory()
    train()
