"""One scripted demonstration: an expert's actions plus noise, recorded as they were executed."""

# First, because it says what to do if MuJoCo finds no OpenGL.
import lerobot_wm.envs.rendering  # noqa: F401

# isort: split
from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any

import metaworld.policies
import numpy as np

from lerobot_wm.constants import (
    ACTION,
    DENSE_REWARD,
    DONE,
    MAX_EPISODE_STEPS,
    OBS_ENV_STATE,
    OBS_STATE,
    REWARD,
    STATE_DIM,
    SUCCESS,
    TASK,
    TASK_ID,
    VARIATION,
)
from lerobot_wm.envs.rendering import Renderer
from lerobot_wm.envs.simulation import Simulation
from lerobot_wm.envs.tasks import expert_name, task_description, task_id


@dataclass
class Demonstration:
    """A successful episode of T steps, without images.

    Attributes:
        task: Its task.
        variation: Its variation.
        physics: (T, n) simulator states at o_t, for drawing.
        states: (T, 39) Meta-World's full states.
        actions: (T, 4) float32 in [-1, 1].
        dense_rewards: (T,) Meta-World's shaped rewards.
        successes: (T,) bool, True where step t ended in success.
    """

    task: str
    variation: int
    physics: np.ndarray
    states: np.ndarray
    actions: np.ndarray
    dense_rewards: np.ndarray
    successes: np.ndarray


def demonstrate(
    simulation: Simulation,
    variation: int,
    noise: float,
    steps_after_success: int,
    rng: np.random.Generator,
    max_steps: int = MAX_EPISODE_STEPS,
) -> Demonstration | None:
    """Let the task's scripted expert try a variation; None if it has not succeeded after `max_steps` steps.

    The expert's raw actions reach +-12. They are clipped to [-1, 1], Gaussian noise of standard deviation `noise` is
    added, and the sum is clipped again. The episode continues for `steps_after_success` steps after the first success:
    without them it would have no successful observation, because step t ends in o_{t+1}.
    """
    expert = getattr(metaworld.policies, expert_name(simulation.task))()
    state = simulation.reset(variation)
    physics, states, actions, dense_rewards, successes = [], [], [], [], []
    last_step = max_steps
    for t in range(max_steps):
        action = np.clip(expert.get_action(state), -1.0, 1.0)
        action = np.clip(action + rng.normal(0.0, noise, action.shape), -1.0, 1.0).astype(np.float32)
        physics.append(simulation.save())
        states.append(state)
        result = simulation.step(action)
        actions.append(action)
        dense_rewards.append(result.dense_reward)
        successes.append(result.success)
        state = result.state
        if result.success and last_step == max_steps:
            last_step = t + steps_after_success
        if t >= last_step:
            break
    if not any(successes):
        return None
    return Demonstration(
        task=simulation.task,
        variation=variation,
        physics=np.array(physics),
        states=np.array(states),
        actions=np.array(actions),
        dense_rewards=np.array(dense_rewards),
        successes=np.array(successes),
    )


def dataset_frames(
    demonstration: Demonstration, simulation: Simulation, renderers: Mapping[str, Renderer]
) -> list[dict[str, Any]]:
    """Render a demonstration and convert it to LeRobot frames (see data/schema.py).

    Images are rendered only for successes, so that a failed attempt costs only its physics.

    Args:
        demonstration: The demonstration.
        simulation: A simulation of its task.
        renderers: Image feature -> renderer.
    """
    demo = demonstration
    done = np.logical_or.accumulate(demo.successes)
    frames = []
    for t in range(len(demo.actions)):
        simulation.restore(demo.physics[t])
        frames.append(
            {
                **{
                    key: renderer.render(simulation.model, simulation.data)
                    for key, renderer in renderers.items()
                },
                OBS_STATE: demo.states[t, :STATE_DIM].astype(np.float32),
                OBS_ENV_STATE: demo.states[t].astype(np.float32),
                ACTION: demo.actions[t],
                REWARD: demo.successes[t : t + 1].astype(np.float32),
                DENSE_REWARD: demo.dense_rewards[t : t + 1].astype(np.float32),
                SUCCESS: demo.successes[t : t + 1],
                DONE: done[t : t + 1],
                TASK_ID: np.array([task_id(demo.task)], dtype=np.int16),
                VARIATION: np.array([demo.variation], dtype=np.int16),
                TASK: task_description(demo.task),
            }
        )
    return frames
