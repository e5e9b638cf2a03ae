"""The demonstrator of ALOHA's cube transfer, for examples/env_scripts.py."""

from typing import Any

import mujoco
import numpy as np


class HandOver:
    """ALOHA: the right gripper takes the cube off the table and holds it out, the left one takes hold of it too.

    An episode is planned at its start: what poses the grippers pass, the joint angles that lead there, and smooth ways
    between these. gym_aloha ends it at the left gripper's first touch of the lifted cube, so the plan ends with both
    grippers closed on it; the right one does not let go.

    Lengths are in metres, x from the left arm to the right one and z upwards from the table. Angles are in radians.

    Args:
        rng: The source of the place, pace and noise: no two episodes are alike.
        env: gym_aloha's environment of the cube transfer, as its reset has left it.
    """

    LYING = 0.02  # height of the cube's centre on the table; the reset drops it from a little above
    ABOVE = np.array([0.0, 0.0, 0.1])  # from the cube, where the right gripper comes from
    MEETING = np.array([0.0, 0.5, 0.23])  # where the cube is handed over, half way between the arms
    BESIDE = np.array([-0.1, 0.0, 0.0])  # from there, where the left gripper comes from
    TILT = 1.2  # of the right gripper, whose fingers point down, so that the left one has room beside it
    # Where the search for the right arm's angles starts. The gripper hangs from its wrist: close to a straight wrist,
    # where two joints turn about one axis, a small way of the gripper is a long one of the joints.
    HANGING = np.array([0.0, -0.4, 0.7, 0.0, 1.0, 0.0])
    NOISE = 0.005  # standard deviation of the noise on the angles
    MEMORY = 0.95  # share of the noise that a step leaves to the next

    def __init__(self, rng: np.random.Generator, env: Any) -> None:
        physics = env._env.physics
        model = physics.model.ptr
        start = env._env.task.get_qpos(physics)  # (14,), in the order of the actions
        cube = np.array([*physics.data.qpos[-7:-5], self.LYING])
        meeting = self.MEETING + rng.uniform(-0.02, 0.02, 3)
        tilt = self.TILT + rng.uniform(-0.1, 0.1)
        # Columns: where the fingers point, along what they open, and across both. The right one's open sideways and the
        # left one's upwards, so that each finds a free pair of the cube's sides.
        down = np.array([[-np.cos(tilt), 0, -np.sin(tilt)], [0, -1, 0], [-np.sin(tilt), 0, np.cos(tilt)]]).T
        rolled = np.array([[1, 0, 0], [0, 0, 1], [0, -1, 0]]).T

        left_rest, rest = start[:6], start[6]
        above = joint_angles(model, "right", cube + self.ABOVE, down, self.HANGING)
        around = joint_angles(model, "right", cube, down, above)
        lifted = joint_angles(model, "right", meeting, down, above)
        beside = joint_angles(model, "left", meeting + self.BESIDE, rolled, left_rest)
        taking = joint_angles(model, "left", meeting, rolled, beside)
        # Steps on the way there; angles and opening, from 0 to 1, of the left arm and of the right one.
        plan = [
            (50, left_rest, rest, above, 1),
            (30, left_rest, rest, around, 1),
            (15, left_rest, rest, around, 0),
            (60, beside, 1, lifted, 0),
            (30, taking, 1, lifted, 0),
            (15, taking, 0, lifted, 0),
        ]
        ways, here = [], start
        for steps, left, left_opening, right, right_opening in plan:
            there = np.array([*left, left_opening, *right, right_opening])
            time = np.linspace(0, 1, round(steps * rng.uniform(0.8, 1.2)))[:, None]
            ways.append(here + (there - here) * (3 - 2 * time) * time**2)  # starts and ends at rest
            here = there
        self._actions = np.concatenate(ways)  # (T, 14)
        self._step = 0
        self._rng = rng
        self._noise = np.zeros(14)

    def __call__(self, state: np.ndarray, info: dict[str, Any]) -> np.ndarray:
        """The angles to go to and the gripper's opening, 0 to 1, of the left arm and of the right one, (14,)."""
        fresh = np.sqrt(1 - self.MEMORY**2) * self.NOISE * self._rng.standard_normal(14)
        fresh[[6, 13]] = 0  # the grippers
        self._noise = self.MEMORY * self._noise + fresh
        action = self._actions[min(self._step, len(self._actions) - 1)]
        self._step += 1
        return action + self._noise


def joint_angles(
    model: mujoco.MjModel, arm: str, place: np.ndarray, orientation: np.ndarray, near: np.ndarray
) -> np.ndarray:
    """The angles (6,) of an arm's joints that bring its gripper to a pose, by damped least squares.

    Args:
        model: Both arms.
        arm: left or right.
        place: Of the middle between the fingertips, (3,).
        orientation: Of the gripper, (3, 3).
        near: Angles to start from, (6,).

    Raises:
        ValueError: None were found.
    """
    fingertips = np.array([0.14, 0.0, 0.0])  # in the gripper's own frame
    data = mujoco.MjData(model)
    gripper = model.body(f"vx300s_{arm}/gripper_link").id
    first = model.joint(f"vx300s_{arm}/waist").qposadr[0]
    joints = slice(first, first + 6)  # of positions and speeds alike: the cube, which has more, comes last
    data.qpos[joints] = near
    shift, turn = np.zeros((3, model.nv)), np.zeros((3, model.nv))
    for _ in range(200):
        mujoco.mj_kinematics(model, data)
        mujoco.mj_comPos(model, data)
        frame = data.xmat[gripper].reshape(3, 3)
        here = data.xpos[gripper] + frame @ fingertips
        error = np.concatenate([place - here, np.cross(frame.T, orientation.T).sum(axis=0) / 2])
        if np.abs(error).max() < 1e-3:
            return data.qpos[joints].copy()
        mujoco.mj_jac(model, data, shift, turn, here, gripper)
        jacobian = np.concatenate([shift, turn])[:, joints]
        data.qpos[joints] += jacobian.T @ np.linalg.solve(jacobian @ jacobian.T + 1e-3 * np.eye(6), error)
    raise ValueError(f"No angles of the {arm} arm bring its gripper to {place}.")
