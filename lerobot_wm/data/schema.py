"""The features of a Meta-World demonstration dataset, as in LeRobot's public Meta-World data.

Frame t holds the observation o_t, the action a_t executed there, and the reward, success and done that arrive
with o_{t+1}.
"""

from collections.abc import Iterable
from pathlib import Path
from typing import Any

from lerobot_wm.constants import (
    ACTION,
    ACTION_DIM,
    DENSE_REWARD,
    DONE,
    ENV_STATE_DIM,
    OBS_ENV_STATE,
    OBS_STATE,
    REWARD,
    STATE_DIM,
    SUCCESS,
    TASK_ID,
    VARIATION,
)

# How `lerobot-wm collect` made the dataset.
COLLECTION_RECORD = Path("meta", "collection.json")
STATE_NAMES = ["x", "y", "z", "gripper"]


def metaworld_features(image_size: int, image_keys: Iterable[str]) -> dict[str, dict[str, Any]]:
    """The dtype, shape and names of each feature, as LeRobot describes them.

    `next.reward` is the sparse reward, 1 where a step ends in success; `next.dense_reward` is Meta-World's shaped
    reward; `next.done` is True from the first success on.

    Args:
        image_size: Height and width of every camera's images in pixels.
        image_keys: Feature keys of the cameras.
    """
    shape = (image_size, image_size, 3)
    return {
        **{
            key: {"dtype": "video", "shape": shape, "names": ["height", "width", "channels"]}
            for key in image_keys
        },
        OBS_STATE: {"dtype": "float32", "shape": (STATE_DIM,), "names": STATE_NAMES},
        OBS_ENV_STATE: {"dtype": "float32", "shape": (ENV_STATE_DIM,), "names": None},
        ACTION: {"dtype": "float32", "shape": (ACTION_DIM,), "names": STATE_NAMES},
        REWARD: {"dtype": "float32", "shape": (1,), "names": None},
        DENSE_REWARD: {"dtype": "float32", "shape": (1,), "names": None},
        SUCCESS: {"dtype": "bool", "shape": (1,), "names": None},
        DONE: {"dtype": "bool", "shape": (1,), "names": None},
        TASK_ID: {"dtype": "int16", "shape": (1,), "names": None},
        VARIATION: {"dtype": "int16", "shape": (1,), "names": None},
    }
