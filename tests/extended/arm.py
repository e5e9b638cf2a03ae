"""A robot for `lerobot-rollout`: a simulated arm of three joints, and cameras that show where it is.

LeRobot finds the class of a robot by the names: `Arm` and `ArmConfig` in a module `arm`.
"""

import json
import signal
import sys
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, ClassVar
from unittest.mock import patch

import numpy as np
from lerobot.robots import Robot, RobotConfig
from lerobot.scripts import lerobot_rollout

JOINTS = ("shoulder.pos", "elbow.pos", "gripper.pos")


@RobotConfig.register_subclass("simulated_arm")
@dataclass(kw_only=True)
class ArmConfig(RobotConfig):
    """Height and width of each camera, and how many of the joints there are."""

    image_sizes: dict[str, list[int]] = field(default_factory=lambda: {"front": [48, 64]})
    n_joints: int = len(JOINTS)


class Arm(Robot):
    """Each joint goes a tenth of the way to its goal per step; each camera draws one bar per joint."""

    config_class = ArmConfig
    name = "simulated_arm"
    made: ClassVar[list["Arm"]] = []  # for tests to look at: LeRobot makes the robot and keeps it to itself

    def __init__(self, config: ArmConfig) -> None:
        super().__init__(config)
        self.config = config
        self.joints = dict.fromkeys(JOINTS[: config.n_joints], 0.0)
        self._connected = False
        self.made.append(self)

    @property
    def action_features(self) -> dict[str, type]:
        return dict.fromkeys(self.joints, float)

    @property
    def observation_features(self) -> dict[str, Any]:
        cameras = {name: (*size, 3) for name, size in self.config.image_sizes.items()}
        return {**self.action_features, **cameras}

    @property
    def is_connected(self) -> bool:
        return self._connected

    @property
    def is_calibrated(self) -> bool:
        return True

    def connect(self, calibrate: bool = True) -> None:
        self._connected = True

    def calibrate(self) -> None:
        pass

    def configure(self) -> None:
        pass

    def get_observation(self) -> dict[str, Any]:
        return {
            **self.joints,
            **{name: self._picture(*size) for name, size in self.config.image_sizes.items()},
        }

    def send_action(self, action: dict[str, Any]) -> dict[str, Any]:
        for joint, goal in action.items():
            self.joints[joint] += 0.1 * (goal - self.joints[joint])
        return action

    def disconnect(self) -> None:
        self._connected = False

    def _picture(self, height: int, width: int) -> np.ndarray:
        picture = np.full((height, width, 3), 40, np.uint8)
        for i, angle in enumerate(self.joints.values()):
            length = int(width * (0.5 + 0.4 * np.tanh(angle)))
            picture[8 * i + 4 : 8 * i + 10, :length, i % 3] = 220
        return picture


def run_rollout(words: list[str], folder: Path, image_sizes: dict[str, list[int]]) -> Arm:
    """Run a command of `lerobot-rollout` on a simulated arm in place of its robot; returns the arm.

    Args:
        words: The command.
        folder: Where the arm's calibration is looked for.
        image_sizes: Height and width of the arm's cameras.
    """
    words = [
        word for word in words if not word.startswith("--robot.") or word.startswith("--robot.n_joints=")
    ]
    words += [
        "--robot.type=simulated_arm",
        f"--robot.image_sizes={json.dumps(image_sizes)}",
        "--play_sounds=false",
    ]
    words += [f"--robot.calibration_dir={folder}", "--return_to_initial_position=false"]
    # LeRobot's handlers outlive its command.
    numbers = (signal.SIGINT, signal.SIGTERM, signal.SIGHUP, signal.SIGQUIT)
    handlers = {number: signal.getsignal(number) for number in numbers}
    Arm.made.clear()
    try:
        with patch.object(sys, "argv", words):
            lerobot_rollout.main()
    finally:
        for number, handler in handlers.items():
            signal.signal(number, handler)
    return Arm.made[0]
