"""Scripts that act in LeRobot's simulated environments, for examples/record_env.py."""

from typing import Any, Protocol

import gymnasium as gym
import numpy as np
from aloha_script import HandOver


class Script(Protocol):
    """Acts in one episode.

    Args:
        rng: The source of all that is random in the episode.
        env: The environment without its wrappers, as its reset has left it: to be read, not to be changed.
    """

    def __init__(self, rng: np.random.Generator, env: gym.Env) -> None: ...

    def __call__(self, state: np.ndarray, info: dict[str, Any]) -> np.ndarray:
        """The next action (A,), for proprioception (P,) and what the environment says beside its observation."""


class PushToGoal:
    """PushT: go behind the block, seen from its goal, and push; off its centre, where it has to turn as well.

    Lengths are in PushT's own units, of which its table is 512 wide.
    """

    CENTRE = np.array([0.0, 45.0])  # of mass, in the frame of the T
    DETOUR = 100.0  # how far from the centre the block is walked around; its own corners are 75 from it
    STRIDE = 40.0  # how far ahead of the pusher its target is
    LEVER = 60.0  # how far off the centre it is pushed for each radian that it has to turn
    MAX_LEVER = 50.0
    NOISE = 10.0  # standard deviation of the noise on the target: no two episodes are alike

    def __init__(self, rng: np.random.Generator, env: gym.Env) -> None:
        self._rng = rng

    def __call__(self, state: np.ndarray, info: dict[str, Any]) -> np.ndarray:
        """Where the pusher is to go, (2,)."""
        block, goal = info["block_pose"][0], info["goal_pose"][0]  # (x, y, angle)
        centre = block[:2] + _rotated(self.CENTRE, block[2])
        way = goal[:2] + _rotated(self.CENTRE, goal[2]) - centre
        turn = (goal[2] - block[2] + np.pi) % (2 * np.pi) - np.pi
        distance = float(np.linalg.norm(way))
        forward = way / max(distance, 1e-6)
        sideways = _rotated(forward, np.pi / 2)
        on_line = centre + np.clip(-self.LEVER * turn, -self.MAX_LEVER, self.MAX_LEVER) * sideways
        along, aside = (state - on_line) @ forward, (state - on_line) @ sideways
        if along < 0 and abs(aside) < 12:
            stride = min(self.STRIDE, 10 + distance + 20 * abs(turn))  # short near the goal
            target = on_line + (along + stride) * forward
        else:
            target = self._around(state, centre, on_line - self.DETOUR * forward)
        return np.clip(
            target + self.NOISE * self._rng.standard_normal(2), 15, 497
        )  # the table without its walls

    def _around(self, state: np.ndarray, centre: np.ndarray, behind: np.ndarray) -> np.ndarray:
        """The next point on the way around the block to the point behind it, (2,)."""
        here, there = (np.arctan2(*(point - centre)[::-1]) for point in (state, behind))
        rest = (there - here + np.pi) % (2 * np.pi) - np.pi
        if abs(rest) < 0.6:
            return behind
        return centre + _rotated(np.array([1.1 * self.DETOUR, 0.0]), here + 0.6 * np.sign(rest))


# By the environment's --env.task.
SCRIPTS: dict[str, type[Script]] = {"PushT-v0": PushToGoal, "AlohaTransferCube-v0": HandOver}


def _rotated(vector: np.ndarray, angle: float) -> np.ndarray:
    """A vector (2,) turned by an angle in radians."""
    cos, sin = np.cos(angle), np.sin(angle)
    return np.array([cos * vector[0] - sin * vector[1], sin * vector[0] + cos * vector[1]])
