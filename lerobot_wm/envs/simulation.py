"""The physics of a Meta-World task, placed in one of its fixed variations."""

# First, because it says what to do if MuJoCo finds no OpenGL.
import lerobot_wm.envs.rendering  # noqa: F401

# isort: split
import pickle
from typing import Any, NamedTuple

import mujoco
import numpy as np
from metaworld.env_dict import ALL_V3_ENVIRONMENTS
from metaworld.types import Task

from lerobot_wm.constants import CAMERA_NAME, CAMERA_POSITION, REPORTED_VARIATION_SET
from lerobot_wm.envs.variations import rand_vec

# All that mj_step reads.
SAVED_STATE = mujoco.mjtState.mjSTATE_INTEGRATION


class StepResult(NamedTuple):
    """The result of a step: state float64 (39,), Meta-World's shaped reward (0 to 10), and success."""

    state: np.ndarray
    dense_reward: float
    success: bool


class Simulation:
    """A Meta-World v3 task without images.

    States are Meta-World's 39 numbers: hand (m), gripper opening and objects now (18) and one step ago (18),
    then the goal (3).

    Args:
        task: A Meta-World v3 task, such as "reach-v3".
        variation_set: 42, 43 or 44, see envs/variations.py.
    """

    def __init__(self, task: str, variation_set: int = REPORTED_VARIATION_SET) -> None:
        self.task = task
        self.variation_set = variation_set
        self._env: Any = ALL_V3_ENVIRONMENTS[task]()
        self.model: mujoco.MjModel = self._env.model
        self.data: mujoco.MjData = self._env.data
        self.model.camera(CAMERA_NAME).pos[:] = CAMERA_POSITION

    def reset(self, variation: int) -> np.ndarray:
        """Place hand, objects and goal as in a variation, independent of what ran before; returns the state."""
        data = {
            "rand_vec": rand_vec(self.task, variation, self.variation_set),
            "env_cls": type(self._env),
            "partially_observable": False,
        }
        mujoco.mj_resetData(self.model, self.data)
        self._env.set_task(Task(env_name=self.task, data=pickle.dumps(data)))
        self._env.reset()
        # Meta-World moves objects in the model but does not recompute positions: without this, the first observation
        # and image would show them where they were in the previous episode.
        mujoco.mj_forward(self.model, self.data)
        state = self._env._get_obs()
        # There is no previous step.
        state[18:36] = state[:18]
        self._env._prev_obs = state[:18].copy()
        return state

    def step(self, action: np.ndarray) -> StepResult:
        """Advance by 0.0125 s with an action (4,) in [-1, 1]."""
        state, dense_reward, _, _, info = self._env.step(action)
        return StepResult(state, float(dense_reward), bool(info["success"]))

    def save(self) -> np.ndarray:
        """The physics state, to `restore` within the same variation."""
        saved = np.empty(mujoco.mj_stateSize(self.model, SAVED_STATE))
        mujoco.mj_getState(self.model, self.data, saved, SAVED_STATE)
        return saved

    def restore(self, saved: np.ndarray) -> None:
        """Return to a saved physics state, ready to be rendered."""
        mujoco.mj_setState(self.model, self.data, saved, SAVED_STATE)
        mujoco.mj_forward(self.model, self.data)
