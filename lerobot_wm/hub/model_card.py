"""The model card of our policy types: what it is, how it was trained, how well it does, how to use it."""

from collections.abc import Sequence
from dataclasses import dataclass
from importlib.metadata import version
from pathlib import Path
from typing import Self

import draccus
from huggingface_hub import ModelCard, ModelCardData
from lerobot.configs import FeatureType, PreTrainedConfig
from lerobot.configs.train import TrainPipelineConfig
from lerobot.datasets.dataset_metadata import LeRobotDatasetMetadata

from lerobot_wm.constants import (
    ACTION,
    ENV_TYPE,
    IMAGE_SIZE,
    OBS_ENV_STATE,
    OBS_IMAGE,
    OBS_IMAGES,
    OBS_LATENT,
    TASK,
    TASK_SETS,
)
from lerobot_wm.data.latents import LatentRecord, dataset_fingerprint
from lerobot_wm.envs.cameras import CAMERAS
from lerobot_wm.envs.tasks import all_tasks, task_description
from lerobot_wm.hub.train_command import train_command
from lerobot_wm.markdown import Markdown, render


def eval_command(config: PreTrainedConfig, repo_id: str) -> str:
    """In Meta-World, with its tasks and cameras, if it knows no other; else in an environment to be filled in.

    Args:
        config: Of a policy that acts.
        repo_id: Where it is published.
    """
    tasks = _metaworld_tasks(getattr(config, "tasks", []))
    images = [key for key, feature in config.input_features.items() if feature.type is FeatureType.VISUAL]
    # A single camera's key does not tell which it is: the environment's own default is taken.
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
    """The tasks' names, or their set's, as `--env.task` takes them; None where one is not Meta-World's."""
    # Of two tasks that share a description, the first.
    names = {task_description(name): name for name in reversed(all_tasks())}
    if not descriptions or not set(descriptions) <= set(names):
        return None
    tasks = [names[description] for description in descriptions]
    for name, members in TASK_SETS.items():
        if set(members) == set(tasks):
            return name
    return ",".join(tasks)


PACKAGES = ("lerobot_policy_wm", "lerobot", "torch")
IMAGINATION = "imagination.webp"  # beside the card, where there is one


@dataclass(frozen=True)
class TrainingData:
    """What a card says of the dataset a policy was trained on.

    Attributes:
        repo_id: Its name.
        episodes, frames: How many.
        fps: Frames a second.
        robot_type: What it was recorded on, as LeRobot names it; None where it does not say.
        tasks: Its task strings.
        fingerprint: `dataset_fingerprint` of it.
        latents: Their record, where it holds latents.
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
    policy_class: type,
    config: PreTrainedConfig,
    repo_id: str,
    cfg: TrainPipelineConfig | None,
    data: TrainingData | None,
    results: str | None = None,
    imagined_tasks: list[str] | None = None,
    *,
    features_read: Sequence[str],
    makes_latents: bool,
) -> ModelCard:
    """Write the card.

    Args:
        policy_class: Of the policy.
        config: Its configuration.
        repo_id: Where it is published.
        cfg: Of the run that trained it; None where that is not known.
        data: What it was trained on; None where that is not on this machine.
        results: Tables of an evaluation, in Markdown.
        imagined_tasks: What the columns of `IMAGINATION` show, which is published with the card; None where there is
            no such file.
        features_read: Keys of the inputs it reads; a world model's configuration keeps all that its dataset has.
        makes_latents: Whether it is a world model, or what stands in its place, and not a policy that acts.
    """
    settings = draccus.encode(config)
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
        action_shape=(1, *config.output_features[ACTION].shape),
        inputs={key: tuple(config.input_features[key].shape) for key in features_read},
        run=cfg,
        command=Markdown(train_command(cfg, data.latents if data else None)) if cfg else None,
        data=data,
        versions={package: version(package) for package in PACKAGES},
        results=None if results is None else Markdown(results),
        imagination=IMAGINATION,
        imagined_tasks=imagined_tasks,
    )
    return ModelCard(f"---\n{metadata.to_yaml()}\n---\n\n{body}")


def _example(config: PreTrainedConfig, settings: dict) -> str:
    """A line of Python that makes inputs of the right shapes."""
    if config.type == "wm_rssm":
        rssm = settings["rssm"]
        shapes = [(1, 5, rssm["image_channels"], IMAGE_SIZE, IMAGE_SIZE), (1, 5, rssm["action_dim"])]
        proprio = f", torch.zeros(1, 5, {rssm['proprio_dim']})" if rssm["use_proprio"] else ""
        return f"inputs = (torch.rand{shapes[0]}, torch.zeros{shapes[1]}{proprio})  # 5 images, a_t at each"
    batch = [
        f"{key!r}: torch.{'rand' if feature.type is FeatureType.VISUAL else 'zeros'}{(1, *feature.shape)}"
        for key, feature in config.input_features.items()
    ]
    if settings.get("tasks"):
        batch.append(f"{TASK!r}: {settings['tasks'][:1]!r}")
    return f"batch = {{{', '.join(batch)}}}  # images in [0, 1]"
