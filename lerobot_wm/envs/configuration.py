"""The environment type `--env.type=metaworld_mt`."""

import logging
import multiprocessing
from collections.abc import Callable
from dataclasses import dataclass, field
from functools import partial
from typing import Any

import gymnasium as gym
from lerobot.configs import FeatureType, PolicyFeature
from lerobot.envs.configs import EnvConfig
from lerobot.utils.constants import ACTION, OBS_ENV_STATE, OBS_STATE

from lerobot_wm.constants import (
    ACTION_DIM,
    CAMERA_NAME,
    ENV_STATE_DIM,
    ENV_TYPE,
    FPS,
    IMAGE_SIZE,
    MAX_EPISODE_STEPS,
    REPORTED_VARIATION_SET,
    STATE_DIM,
)
from lerobot_wm.envs.cameras import image_features, parse_cameras
from lerobot_wm.envs.tasks import resolve_tasks
from lerobot_wm.envs.variations import check_variation_set
from lerobot_wm.system import usable_cores


@EnvConfig.register_subclass(ENV_TYPE)
@dataclass
class MetaworldMTEnvConfig(EnvConfig):
    """Meta-World tasks, each with 50 fixed variations; `reset(seed=k)` is variation k.

    Args:
        task: A task, a set (mt6, mt10, mt50, ml45, ml45_test) or a comma-separated list.
        variation_set: 42 for reported results, 43 for choosing settings and for probes, or 44 for confirming a final
            choice.
        environment_state: Add the full state, `observation.environment_state` (39,), to the observation.
        image_size: Height and width of the image in pixels.
        camera_name: A camera of the simulator, or several separated by commas: corner2,topview.
        fast_rendering: Render without shadows, reflections, multisampling and details of the robot that are smaller
            than a fifth of a pixel.
        episode_length: Steps until truncation, at most 500.
        obs_type: "pixels_agent_pos", the only supported type.
    """

    task: str = "mt6"
    fps: int = FPS
    variation_set: int = REPORTED_VARIATION_SET
    environment_state: bool = False
    image_size: int = IMAGE_SIZE
    camera_name: str = CAMERA_NAME
    fast_rendering: bool = True
    episode_length: int = MAX_EPISODE_STEPS
    obs_type: str = "pixels_agent_pos"
    features: dict[str, PolicyFeature] = field(
        default_factory=lambda: {
            "action": PolicyFeature(type=FeatureType.ACTION, shape=(ACTION_DIM,)),
            "agent_pos": PolicyFeature(type=FeatureType.STATE, shape=(STATE_DIM,)),
        }
    )
    features_map: dict[str, str] = field(default_factory=lambda: {"action": ACTION, "agent_pos": OBS_STATE})

    def __post_init__(self) -> None:
        """Check the fields and add the features of the cameras."""
        resolve_tasks(self.task)
        check_variation_set(self.variation_set)
        if self.obs_type != "pixels_agent_pos":
            raise ValueError(f"obs_type is '{self.obs_type}'; expected 'pixels_agent_pos'.")
        if self.image_size < 16:
            raise ValueError(f"image_size is {self.image_size}; expected at least 16 pixels.")
        if not 1 <= self.episode_length <= MAX_EPISODE_STEPS:
            raise ValueError(f"episode_length is {self.episode_length}; expected 1 to {MAX_EPISODE_STEPS}.")
        if self.max_parallel_tasks > 1:
            raise ValueError(
                f"max_parallel_tasks is {self.max_parallel_tasks}: LeRobot would let one policy act in several tasks "
                "in turns, which mixes up its recurrent states. Use 1, or `lerobot-wm eval --num_workers`."
            )
        shape = (self.image_size, self.image_size, 3)
        keys = image_features(parse_cameras(self.camera_name))
        for camera, key in keys.items():
            name = "pixels" if len(keys) == 1 else f"pixels/{camera}"
            self.features[name] = PolicyFeature(type=FeatureType.VISUAL, shape=shape)
            self.features_map[name] = key
        if self.environment_state:
            self.features["environment_state"] = PolicyFeature(type=FeatureType.ENV, shape=(ENV_STATE_DIM,))
            self.features_map["environment_state"] = OBS_ENV_STATE

    @property
    def gym_kwargs(self) -> dict[str, Any]:
        """Arguments of `MetaworldMTEnv` except its task."""
        return {
            "variation_set": self.variation_set,
            "environment_state": self.environment_state,
            "image_size": self.image_size,
            "camera_name": self.camera_name,
            "fast_rendering": self.fast_rendering,
            "episode_length": self.episode_length,
        }

    def create_envs(
        self, n_envs: int, use_async_envs: bool = False
    ) -> dict[str, dict[int, gym.vector.VectorEnv]]:
        """Make {task name: {0: vector environment}}, for which LeRobot reports success per task.

        A sub-environment whose episode has ended is neither simulated nor rendered until the next rollout.
        """
        from lerobot.envs.utils import freeze_after_episode_end

        from lerobot_wm.envs.metaworld_mt import MetaworldMTEnv

        use_processes = use_async_envs and n_envs > 1
        envs: dict[str, dict[int, Any]] = {}
        for task in resolve_tasks(self.task):
            env_fn = freeze_after_episode_end(partial(MetaworldMTEnv, task, **self.gym_kwargs))
            envs[task] = {
                0: AsyncEnvs([env_fn] * n_envs)
                if use_processes
                else gym.vector.SyncVectorEnv(
                    [env_fn] * n_envs, autoreset_mode=gym.vector.AutoresetMode.NEXT_STEP
                )
            }
        if use_processes:
            self._prepare_workers(n_envs)
        return envs

    @staticmethod
    def _prepare_workers(n_envs: int) -> None:
        # Workers are forked from a server that imports torch and mujoco once instead of once per worker.
        multiprocessing.get_context("forkserver").set_forkserver_preload(
            ["__main__", "lerobot.envs.utils", "metaworld", "lerobot_wm.envs.metaworld_mt"]
        )
        cores = usable_cores()
        if n_envs > cores:
            logging.warning(
                "%d environment processes share %d cores: --eval.use_async_envs=false is likely faster.",
                n_envs,
                cores,
            )


class AsyncEnvs:
    """Environments in a process each, started at first use: LeRobot evaluates one task after another."""

    def __init__(self, env_fns: list[Callable[[], gym.Env]]) -> None:
        self.num_envs = len(env_fns)
        self._env_fns = env_fns
        self._envs: gym.vector.AsyncVectorEnv | None = None

    def __getattr__(self, name: str) -> Any:
        if self._envs is None:
            self._envs = gym.vector.AsyncVectorEnv(
                self._env_fns, context="forkserver", autoreset_mode=gym.vector.AutoresetMode.NEXT_STEP
            )
        return getattr(self._envs, name)

    def close(self) -> None:
        """Stop the processes, if they were started."""
        if self._envs is not None:
            self._envs.close()
