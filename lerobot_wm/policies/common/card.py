"""The model card of our policy types: what it is, how well it works, how to use it and how to train it again."""

import json
import re
import shlex
from dataclasses import MISSING, dataclass, fields, is_dataclass, replace
from importlib.metadata import version
from pathlib import Path
from typing import Any, Self

import draccus
from draccus import cfgparsing
from huggingface_hub import ModelCard, ModelCardData
from huggingface_hub.errors import HFValidationError
from lerobot.configs import FeatureType, PreTrainedConfig
from lerobot.configs.default import DatasetConfig
from lerobot.configs.train import TrainPipelineConfig
from lerobot.datasets.dataset_metadata import LeRobotDatasetMetadata
from lerobot.policies.factory import get_policy_class

from lerobot_wm.constants import (
    ACTION,
    ENV_TYPE,
    IMAGE_SIZE,
    OBS_ENV_STATE,
    OBS_IMAGE,
    OBS_IMAGES,
    OBS_LATENT,
    TASK,
)
from lerobot_wm.data.latents import LatentRecord, dataset_fingerprint
from lerobot_wm.envs.cameras import CAMERAS
from lerobot_wm.envs.tasks import all_tasks, task_description, task_sets
from lerobot_wm.markdown import Markdown, render
from lerobot_wm.policies.common.config import PolicyConfig


def eval_command(config: PolicyConfig, repo_id: str) -> str:
    """The command that evaluates an acting policy, in Meta-World if it has all its tasks and cameras.

    Args:
        config: The policy's configuration.
        repo_id: Where it is published.
    """
    tasks = _metaworld_tasks(getattr(config, "known_tasks", []))
    images = [key for key, feature in config.input_features.items() if feature.type is FeatureType.VISUAL]
    # The key of a single camera does not say which one it is: the environment uses its default.
    cameras = [key.removeprefix(f"{OBS_IMAGES}.") for key in images if key != OBS_IMAGE]
    if tasks is None or not set(cameras) <= set(CAMERAS):
        return f"lerobot-eval --policy.path={repo_id} --env.type=ENVIRONMENT --eval.n_episodes=50 --seed=0"
    flags = [f"--env.camera_name={','.join(cameras)}"] if cameras else []
    sizes = {config.input_features[key].shape[-1] for key in images} - {IMAGE_SIZE}
    flags += [f"--env.image_size={size}" for size in sizes]
    if OBS_ENV_STATE in config.input_features:
        flags.append("--env.environment_state=true")
    command = f"lerobot-wm eval --policy.path={repo_id} --env.type={ENV_TYPE} --env.task={tasks}"
    return " ".join([command, *flags, "--eval.n_episodes=50 --seed=0"])


def _metaworld_tasks(descriptions: list[str]) -> str | None:
    """The names of the tasks, or of their set, for `--env.task`; None if one is not Meta-World's."""
    names = {task_description(name): name for name in all_tasks()}
    if not descriptions or not set(descriptions) <= set(names):
        return None
    tasks = [names[description] for description in descriptions]
    for name, members in task_sets().items():
        if set(members) == set(tasks):
            return name
    return ",".join(tasks)


PACKAGES = ("lerobot_policy_wm", "lerobot", "torch")
# File beside the card, if there is one.
IMAGINATION = "imagination.webp"


@dataclass(frozen=True)
class TrainingData:
    """What a card says about the dataset that a policy was trained on.

    Attributes:
        repo_id: Its name.
        episodes, frames: Their numbers.
        fps: Frames per second.
        robot_type: The robot it was recorded on, as LeRobot names it; None where it does not say.
        tasks: Its task strings.
        fingerprint: Its `dataset_fingerprint`.
        latents: Their record, in a dataset of latents.
    """

    repo_id: str
    episodes: int
    frames: int
    fps: int
    robot_type: str | None
    tasks: list[str]
    fingerprint: str
    latents: LatentRecord | None

    @classmethod
    def of(cls, meta: LeRobotDatasetMetadata) -> Self:
        """Read it from a dataset on this machine."""
        root = Path(meta.root)
        return cls(
            repo_id=meta.repo_id,
            episodes=meta.total_episodes,
            frames=meta.total_frames,
            fps=meta.fps,
            robot_type=meta.robot_type,
            tasks=[str(task) for task in meta.tasks.index],
            fingerprint=dataset_fingerprint(root),
            latents=LatentRecord.read(root) if OBS_LATENT in meta.features else None,
        )


def model_card(
    config: PolicyConfig,
    repo_id: str,
    cfg: TrainPipelineConfig | None,
    data: TrainingData | None,
    results: str | None = None,
    imagined_tasks: list[str] | None = None,
) -> ModelCard:
    """Write the card.

    Args:
        config: The policy's configuration.
        repo_id: Where it is published.
        cfg: The configuration of the run that trained it; None where that is unknown.
        data: What it was trained on; None where that is not on this machine.
        results: Tables of an evaluation, in Markdown.
        imagined_tasks: What the columns of `IMAGINATION` show, which is published with the card; None where there is
            no such file.
    """
    policy_class = get_policy_class(config.type)
    makes_latents = not config.chooses_actions
    settings = draccus.encode(config)
    # A policy on latents holds the world model's settings.
    rssm = settings.get("rssm") or (settings.get("world_model") or {}).get("rssm") or {}
    datasets = [data.latents.source_repo_id if data.latents else data.repo_id] if data else None
    metadata = ModelCardData(
        license=config.license or "apache-2.0",
        library_name="lerobot",
        pipeline_tag="robotics",
        tags=sorted({"robotics", "lerobot", "lerobot_wm", config.type, *(config.tags or [])}),
        datasets=datasets,
    )
    body = render(
        Path(__file__).with_name("model_card.md.j2"),
        type=config.type,
        settings=settings,
        makes_latents=makes_latents,
        repo_id=repo_id,
        module=policy_class.__module__,
        class_name=policy_class.__name__,
        example=Markdown(_example(config, settings)),
        evaluation=None if makes_latents else Markdown(eval_command(config, repo_id)),
        hidden_action_share=rssm.get("hidden_action_share"),
        action_shape=(1, *config.output_features[ACTION].shape),
        tasks=getattr(config, "known_tasks", []),
        inputs={key: tuple(config.input_features[key].shape) for key in config.features_read},
        run=cfg,
        command=Markdown(train_command(cfg, data.latents if data else None)) if cfg else None,
        data=data,
        versions={package: version(package) for package in PACKAGES},
        results=None if results is None else Markdown(results),
        imagination=IMAGINATION,
        imagined_tasks=imagined_tasks,
    )
    return ModelCard(f"---\n{metadata.to_yaml()}\n---\n\n{body}")


def _example(config: PolicyConfig, settings: dict) -> str:
    """A line of Python that makes inputs of the right shapes."""
    if config.type == "wm_rssm":
        rssm = settings["rssm"]
        shapes = [(1, 5, rssm["image_channels"], *[rssm["image_size"]] * 2), (1, 5, rssm["action_dim"])]
        proprio = f", torch.zeros(1, 5, {rssm['proprio_dim']})" if rssm["use_proprio"] else ""
        return f"inputs = (torch.rand{shapes[0]}, torch.zeros{shapes[1]}{proprio})  # 5 images, a_t at each"
    batch = [
        f"{key!r}: torch.{'rand' if feature.type is FeatureType.VISUAL else 'zeros'}{(1, *feature.shape)}"
        for key, feature in config.input_features.items()
    ]
    if tasks := getattr(config, "known_tasks", []):
        batch.append(f"{TASK!r}: {tasks[:1]!r}")
    return f"batch = {{{', '.join(batch)}}}  # images in [0, 1]"


# Filled in when a policy is created, from its dataset, its world model or its checkpoint.
_FILLED_IN = {
    "policy.input_features",
    "policy.output_features",
    "policy.use_peft",
    "policy.tasks",
    "policy.trained_tasks",
    "policy.relative_indices",
    "policy.rssm.image_channels",
    "policy.rssm.action_dim",
    "policy.rssm.proprio_dim",
    "policy.world_model",
    "policy.world_model_fingerprint",
    "policy.iql.trained_betas",
}
# Settings of the machine and the Hub, of logs, checkpoints and evaluation: they do not change what is learned.
_NO_MATTER = {
    "policy.device",
    "policy.push_to_hub",
    "policy.repo_id",
    "policy.private",
    "policy.tags",
    "policy.license",
    "dataset.root",
    "dataset.video_backend",
    "output_dir",
    "job_name",
    "job",
    "resume",
    "num_workers",
    "prefetch_factor",
    "persistent_workers",
    "dataloader_multiprocessing_context",
    "env",
    "env_eval_freq",
    "eval",
    "log_freq",
    "save_checkpoint",
    "save_checkpoint_to_hub",
    "save_freq",
    "wandb",
}
# Written by `train_command` and `_policy_flags`.
_OF_THEIR_OWN = {
    "policy",
    "policy.pretrained_path",
    "policy.pretrained_revision",
    "dataset",
    "use_policy_training_preset",
    "optimizer",
    "scheduler",
}
_LEFT_OUT = _FILLED_IN | _NO_MATTER | _OF_THEIR_OWN
# Shown even at their defaults.
_ALWAYS = ("batch_size", "steps", "seed")


def train_command(cfg: TrainPipelineConfig, latents: LatentRecord | None) -> str:
    """A `lerobot-wm train` command with every flag that matters to the result and is not at its default.

    Paths on the machine that trained are left out: they are private, and useless elsewhere.

    Args:
        cfg: The run's configuration; it trained a policy.
        latents: The record of its dataset, if it was one of latents: the command encodes their source.
    """
    flags = _policy_flags(cfg.policy, cfg.resume)
    dataset = cfg.dataset
    if latents is not None:
        dataset = replace(dataset, repo_id=latents.source_repo_id, revision=None)
    flags |= _changed(dataset, vars(DatasetConfig(repo_id="")), "dataset.")
    if not cfg.use_policy_training_preset:
        flags["use_policy_training_preset"] = False
        for name, setting in {"optimizer": cfg.optimizer, "scheduler": cfg.scheduler}.items():
            flags |= {f"{name}.type": setting.type, **_changed(setting, {}, f"{name}.")}
    usual = {name: value for name, value in _defaults(TrainPipelineConfig).items() if name not in _ALWAYS}
    flags |= _changed(cfg, usual)
    # LeRobot pushes by default, and then needs a repository.
    flags["policy.push_to_hub"] = False
    return " ".join(
        ["lerobot-wm train", *(shlex.quote(f"--{key}={_text(value)}") for key, value in flags.items())]
    )


def _policy_flags(policy: PreTrainedConfig, resumed: bool) -> dict[str, object]:
    """The policy's type or checkpoint, and its own settings that differ from the defaults there."""
    # A resumed run loads its own checkpoint.
    if policy.pretrained_path is None or resumed:
        flags = {"policy.type": policy.type, **_changed(policy, _defaults(type(policy)), "policy.")}
    else:
        flags = {"policy.path": _public(policy.pretrained_path, "CHECKPOINT")}
        if policy.pretrained_revision is not None:
            flags["policy.pretrained_revision"] = policy.pretrained_revision
        flags |= _changed(policy, _settings_of_checkpoint(policy), "policy.")
        flags.pop("policy.world_model_path", None)  # the world model is in the checkpoint
    if hasattr(policy, "world_model_path"):
        flags.pop("policy.image_key", None)  # its world model's
    return flags


def _settings_of_checkpoint(policy: PreTrainedConfig) -> dict[str, Any]:
    """The settings of the checkpoint that training started from; empty if it is no longer here."""
    try:
        return vars(
            PreTrainedConfig.from_pretrained(
                policy.pretrained_path, revision=policy.pretrained_revision, local_files_only=True
            )
        )
    except (FileNotFoundError, HFValidationError):
        return {}


def _changed(config: Any, usual: dict[str, Any], prefix: str = "") -> dict[str, object]:
    """Settings that differ from the usual ones or have no usual value, under dotted names."""
    flags: dict[str, object] = {}
    for item in fields(config):
        key, value = prefix + item.name, getattr(config, item.name)
        if not item.init or key in _LEFT_OUT:
            continue
        if is_dataclass(value):
            known = usual.get(item.name)
            flags |= _changed(value, {} if known is None else vars(known), f"{key}.")
        elif item.name not in usual or draccus.encode(value) != draccus.encode(usual[item.name]):
            is_place = item.name.endswith("_path") and value is not None
            flags[key] = _public(value, item.name.removesuffix("_path").upper()) if is_place else value
    return flags


def _defaults(kind: type) -> dict[str, Any]:
    """Defaults of a configuration class; an instance would fill in what fits this machine."""
    defaults = {}
    for item in fields(kind):
        if item.default is not MISSING:
            defaults[item.name] = item.default
        elif item.default_factory is not MISSING:
            defaults[item.name] = item.default_factory()
    return defaults


def _public(path: str | Path, name: str) -> str:
    """A Hub id, user/name or user/name@revision, unchanged; a placeholder instead of a folder."""
    is_hub_id = re.fullmatch(r"[\w-][\w.-]*/[\w.-]+(@.+)?", str(path)) is not None
    return str(path) if is_hub_id and not Path(path).exists() else name


def _text(value: object) -> str:
    """A value as draccus reads it from the command line."""
    if isinstance(value, str):
        is_plain = re.fullmatch(r"([A-Za-z]|[0-9a-f]{40})[\w./@,-]*", value) is not None
        if is_plain and cfgparsing.parse_string(value) == value:  # not null, yes or the like
            return value
    return json.dumps(draccus.encode(value))
