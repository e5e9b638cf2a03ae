"""Environment steps with images: one environment in this process, or several in their own processes."""

from collections.abc import Callable
from functools import partial
from itertools import cycle
from pathlib import Path
from typing import Any

import gymnasium as gym
import metaworld
import numpy as np
from gymnasium.vector import AsyncVectorEnv, SyncVectorEnv
from gymnasium.wrappers import AddRenderObservation
from lerobot.envs.metaworld import MetaworldEnv

from benchmarks.timing import Prepared, rate
from lerobot_wm.constants import ACTION_DIM, CAMERA_NAME, IMAGE_SIZE, MT6
from lerobot_wm.envs.metaworld_mt import MetaworldMTEnv


def ours(folder: Path, processes: int, seconds: float) -> Prepared:
    """Time steps of metaworld_mt with 64x64 pixels."""
    return _prepared(MetaworldMTEnv, processes, seconds)


def lerobot(folder: Path, processes: int, seconds: float) -> Prepared:
    """Time steps of LeRobot's metaworld, which draws 480x480 pixels."""
    return _prepared(partial(MetaworldEnv, obs_type="pixels_agent_pos"), processes, seconds)


def metaworld_64(folder: Path, processes: int, seconds: float) -> Prepared:
    """Time steps of Meta-World itself with 64x64 pixels and its default drawing settings."""
    return _prepared(_metaworld, processes, seconds)


def _metaworld(task: str) -> gym.Env:
    mt1 = metaworld.MT1(task, seed=42)
    env = mt1.train_classes[task](
        render_mode="rgb_array", camera_name=CAMERA_NAME, width=IMAGE_SIZE, height=IMAGE_SIZE
    )
    env.set_task(mt1.train_tasks[0])
    return AddRenderObservation(env, render_only=False)


def _prepared(make_env: Callable[[str], gym.Env], processes: int, seconds: float) -> Prepared:
    def measure() -> float:
        rates = [_steps_per_second(make_env, task, processes, seconds / len(MT6)) for task in MT6]
        return len(rates) / sum(
            1 / rate for rate in rates
        )  # harmonic mean: all tasks make equally many steps

    return Prepared(measure)


def _steps_per_second(make_env: Callable[[str], gym.Env], task: str, processes: int, seconds: float) -> float:
    """Measure the steps per second of all processes together, with small random actions."""
    env_fns = [partial(make_env, task)] * processes
    envs: Any = SyncVectorEnv(env_fns) if processes == 1 else AsyncVectorEnv(env_fns, context="forkserver")
    actions = np.random.default_rng(0).uniform(-0.2, 0.2, (1000, processes, ACTION_DIM)).astype(np.float32)
    endless = cycle(actions)
    envs.reset(seed=0)

    def step() -> int:
        envs.step(next(endless))
        return processes

    for _ in range(3):  # builds models and OpenGL contexts
        step()
    value = rate(step, seconds)
    envs.close()
    return value
