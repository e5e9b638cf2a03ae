"""The command that rolls a policy out, read from what it was trained on."""

from lerobot.configs import FeatureType, PreTrainedConfig

from lerobot_wm.constants import ENV_TYPE, IMAGE_SIZE, OBS_ENV_STATE, OBS_IMAGE, OBS_IMAGES, TASK_SETS
from lerobot_wm.envs.cameras import CAMERAS
from lerobot_wm.envs.tasks import all_tasks, task_description


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
