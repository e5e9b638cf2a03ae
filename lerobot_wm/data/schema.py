"""The features of a Meta-World demonstration dataset, as in LeRobot's public Meta-World data.

Frame t holds the observation o_t, the action a_t executed there, and the reward, success and done that arrive
with o_{t+1}.
"""

from collections.abc import Iterable
from pathlib import Path
from typing import Any

import numpy as np

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

COLLECTION_RECORD = Path("meta", "collection.json")  # how `lerobot-wm collect` made the dataset
RELABEL_RECORD = Path("meta", "relabel.json")  # which column `lerobot-wm relabel` made the reward
STATE_NAMES = ["x", "y", "z", "gripper"]


def metaworld_features(image_size: int, image_keys: Iterable[str]) -> dict[str, dict[str, Any]]:
    """LeRobot's description of each feature: dtype, shape and names.

    `next.reward` is the sparse reward, 1 where the step ends in success; `next.dense_reward` is Meta-World's
    shaped one; `next.done` is True from the first success on.

    Args:
        image_size: Height and width of every camera's images in pixels.
        image_keys: The cameras' feature keys.
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


def check_finite(arrays: dict[str, np.ndarray], where: str) -> None:
    """Refuse an episode with NaN or infinite values; LeRobot would write them silently.

    Args:
        arrays: feature name -> values of shape (T, ...).
        where: the episode's name for the message.

    Raises:
        ValueError: naming the feature and the first frame concerned.
    """
    for name, values in arrays.items():
        bad = ~np.isfinite(values).reshape(len(values), -1).all(axis=1)
        if bad.any():
            raise ValueError(f"{where}, frame {int(bad.argmax())}: {name} is not finite; episode refused.")
