"""The model card of our policy types: what it is, how well it works, how to use it and how to train it again."""

import shlex
from dataclasses import dataclass
from importlib.metadata import version
from pathlib import Path
from typing import Self

import draccus
from huggingface_hub import ModelCard, ModelCardData
from lerobot.configs import FeatureType
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
        command=Markdown(train_command(repo_id, cfg, data.latents if data else None)) if cfg else None,
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


def train_command(repo_id: str, cfg: TrainPipelineConfig, latents: LatentRecord | None) -> str:
    """The command that repeats a run, from the settings that are published with its checkpoint.

    Places on the machine that trained are replaced, except a folder that --policy.path named. The world model of a
    policy is in its checkpoint.

    Args:
        repo_id: Where the checkpoint is published.
        cfg: The run's configuration.
        latents: The record of its dataset, if it was one of latents: the command encodes their source.
    """
    flags = {"config_path": repo_id, "dataset.root": "null"}
    if latents is not None:
        flags |= {"dataset.repo_id": latents.source_repo_id, "dataset.revision": "null"}
    if cfg.resume:  # from its own checkpoint, which then stands where the one of --policy.path does
        flags |= {"resume": "false", "policy.pretrained_path": "null"}
    started_new = cfg.resume or cfg.policy.pretrained_path is None
    if started_new and getattr(cfg.policy, "world_model_path", None) is not None:
        flags["policy.world_model_path"] = repo_id
    flags |= {"policy.push_to_hub": "false", "output_dir": "outputs/again"}
    return " ".join(
        ["lerobot-wm train", *(shlex.quote(f"--{name}={value}") for name, value in flags.items())]
    )
