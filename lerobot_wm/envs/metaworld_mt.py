"""A Meta-World task with its 50 fixed variations as a gymnasium environment."""

from typing import TYPE_CHECKING, Any

import gymnasium as gym
import numpy as np

from lerobot_wm.constants import (
    ACTION_DIM,
    CAMERA_NAME,
    ENV_STATE_DIM,
    FPS,
    IMAGE_SIZE,
    MAX_EPISODE_STEPS,
    NUM_VARIATIONS,
    REPORTED_VARIATION_SET,
    STATE_DIM,
)
from lerobot_wm.envs.cameras import parse_cameras
from lerobot_wm.envs.rendering import Renderer, RenderKey
from lerobot_wm.envs.tasks import task_description

if TYPE_CHECKING:
    from lerobot_wm.envs.simulation import Simulation

Observation = dict[str, Any]


class MetaworldMTEnv(gym.Env):
    """One Meta-World v3 task; `reset(seed=k)` restores fixed variation k of its split, bit for bit.

    - Observation: `pixels`, uint8 RGB (image_size, image_size, 3), or a dictionary of images for several cameras;
      `agent_pos`, float32 (4,): the end effector's position (m) and the gripper's opening (0 to 1); optionally
      `environment_state`, float32 (39,).
    - Action: float32 (4,) in [-1, 1]: the end effector's movement, up to 1 cm per axis, and the gripper's effort.
    - Reward: 1 on a step that ends in success, else 0.
    - `info`: `is_success`, `variation` and, after a step, `dense_reward` (Meta-World's shaped reward, 0 to 10).

    The simulator is built at the first reset, so that creating many environments is fast.

    Args:
        task: A Meta-World v3 task, such as "reach-v3".
        variation_set: 42 for reported results, 43 for choosing settings and for probes, or 44 for confirming a final
            choice.
        environment_state: Add the full state to the observation.
        image_size: Height and width of the image in pixels.
        camera_name: A camera of the simulator, or several separated by commas; "corner2" is moved so that every task is
            in view.
        fast_rendering: Render without shadows, reflections, multisampling and details of the robot that are smaller
            than a fifth of a pixel.
        episode_length: Steps until truncation, at most 500.
    """

    metadata = {"render_modes": ["rgb_array"], "render_fps": FPS}  # noqa: RUF012 (gymnasium's interface)
    render_mode = "rgb_array"

    def __init__(
        self,
        task: str,
        variation_set: int = REPORTED_VARIATION_SET,
        environment_state: bool = False,
        image_size: int = IMAGE_SIZE,
        camera_name: str = CAMERA_NAME,
        fast_rendering: bool = True,
        episode_length: int = MAX_EPISODE_STEPS,
    ) -> None:
        self.task = task
        self.task_description = task_description(task)
        # LeRobot's rollout reads this name.
        self._max_episode_steps = episode_length
        self._variation_set = variation_set
        self._environment_state = environment_state
        self._render_keys = {
            camera: RenderKey(task, camera, image_size, fast_rendering)
            for camera in parse_cameras(camera_name)
        }
        image_spaces: dict[str, gym.Space] = {
            camera: gym.spaces.Box(0, 255, (image_size, image_size, 3), np.uint8)
            for camera in self._render_keys
        }
        spaces: dict[str, gym.Space] = {
            "pixels": gym.spaces.Dict(image_spaces) if len(image_spaces) > 1 else image_spaces.popitem()[1],
            "agent_pos": gym.spaces.Box(-np.inf, np.inf, (STATE_DIM,), np.float32),
        }
        if environment_state:
            spaces["environment_state"] = gym.spaces.Box(-np.inf, np.inf, (ENV_STATE_DIM,), np.float32)
        self.observation_space = gym.spaces.Dict(spaces)
        self.action_space = gym.spaces.Box(-1.0, 1.0, (ACTION_DIM,), np.float32)
        self._sim: Simulation | None = None
        self._renderers: dict[str, Renderer] = {}
        self._next_index = 0
        self._steps = 0
        self.variation = -1
        self._state = np.zeros(0)
        self._images = {
            camera: np.zeros((image_size, image_size, 3), np.uint8) for camera in self._render_keys
        }

    @property
    def environment_state(self) -> np.ndarray:
        """Meta-World's full state, float64 (39,): hand and objects now and one step ago, and the goal."""
        return self._state.copy()

    def reset(
        self, *, seed: int | None = None, options: dict[str, Any] | None = None
    ) -> tuple[Observation, dict[str, Any]]:
        """Start variation `seed`, modulo their number; without a seed, the next one."""
        super().reset(seed=seed)
        if self._sim is None:
            self._build()
        assert self._sim is not None
        index = self._next_index if seed is None else seed
        self._next_index = index + 1
        self.variation = index % NUM_VARIATIONS
        self._steps = 0
        self._state = self._sim.reset(self.variation)
        return self._observe(), {"is_success": False, "variation": self.variation}

    def step(self, action: np.ndarray) -> tuple[Observation, float, bool, bool, dict[str, Any]]:
        """Execute one action for 0.0125 s.

        Raises:
            ValueError: The action has another shape, or is not finite.
        """
        action = np.asarray(action, dtype=np.float32)
        if action.shape != (ACTION_DIM,) or not np.isfinite(action).all():
            raise ValueError(
                f"{self.task}, variation {self.variation}, step {self._steps}: the action is {action.tolist()}; "
                f"expected {ACTION_DIM} finite numbers."
            )
        if self._sim is None:
            raise RuntimeError(f"{self.task}: call reset() before step().")
        result = self._sim.step(np.clip(action, -1.0, 1.0))
        self._steps += 1
        self._state = result.state
        info = {
            "is_success": result.success,
            "variation": self.variation,
            "dense_reward": result.dense_reward,
        }
        truncated = self._steps >= self._max_episode_steps
        return self._observe(), float(result.success), result.success, truncated, info

    def render(self) -> np.ndarray:
        """Images of the current observation side by side, uint8 (image_size, cameras x image_size, 3)."""
        return np.hstack(list(self._images.values()))

    def close(self) -> None:
        """Free the simulator and its OpenGL memory; the next reset builds them again."""
        if self._sim is not None:
            for key in self._render_keys.values():
                Renderer.release(key)
            self._renderers = {}
            self._sim = None

    def _build(self) -> None:
        from lerobot_wm.envs.simulation import Simulation

        sim = Simulation(self.task, self._variation_set)
        renderers: dict[str, Renderer] = {}
        try:
            for camera, key in self._render_keys.items():
                renderers[camera] = Renderer.acquire(key, sim.model)
        except BaseException:
            for camera in renderers:
                Renderer.release(self._render_keys[camera])
            raise
        self._sim, self._renderers = sim, renderers

    def _observe(self) -> Observation:
        assert self._sim is not None
        self._images = {
            camera: renderer.render(self._sim.model, self._sim.data)
            for camera, renderer in self._renderers.items()
        }
        observation: Observation = {
            "pixels": self._images if len(self._images) > 1 else next(iter(self._images.values())),
            "agent_pos": self._state[:STATE_DIM].astype(np.float32),
        }
        if self._environment_state:
            observation["environment_state"] = self._state.astype(np.float32)
        return observation
