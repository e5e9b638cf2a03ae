"""Names and numbers used in several places: feature keys, task sets, camera, evaluation protocol."""

# Feature keys, equal to LeRobot's. This module imports nothing, so that nn/, world_model/ and rl/ can use it.
OBS_IMAGE = "observation.image"
OBS_IMAGES = "observation.images"
OBS_STATE = "observation.state"
OBS_ENV_STATE = "observation.environment_state"
OBS_LATENT = "observation.latent"
OBS_SHIFTED_LATENTS = "observation.shifted_latents"
ACTION = "action"
REWARD = "next.reward"
DENSE_REWARD = "next.dense_reward"
SUCCESS = "next.success"
DONE = "next.done"
TASK = "task"
VARIATION = "variation"
TASK_ID = "task_id"

# The paper's six tasks (section 4), v3 of Meta-World, in the order of the paper's Table 1.
MT6: tuple[str, ...] = (
    "button-press-topdown-v3",
    "door-open-v3",
    "drawer-open-v3",
    "reach-v3",
    "window-close-v3",
    "window-open-v3",
)

# Meta-World's MT10, in its own order.
MT10: tuple[str, ...] = (
    "reach-v3",
    "push-v3",
    "pick-place-v3",
    "door-open-v3",
    "drawer-open-v3",
    "drawer-close-v3",
    "button-press-topdown-v3",
    "peg-insert-side-v3",
    "window-open-v3",
    "window-close-v3",
)

# Meta-World's ML45: these five tasks are held out, and all others are for pretraining.
ML45_TEST: tuple[str, ...] = (
    "bin-picking-v3",
    "box-close-v3",
    "hand-insert-v3",
    "door-lock-v3",
    "door-unlock-v3",
)

ENV_TYPE = "metaworld_mt"
NUM_VARIATIONS = 50
NUM_SEEN_VARIATIONS = 10  # demonstrations show variations 0-9; 10-49 are never seen in training
# Sets of fixed variations, named by the seed given to metaworld.MT1: other positions of the same objects. Results are
# reported on the first, settings are tuned on the second, and the third confirms final settings once.
REPORTED_VARIATION_SET = 42
SELECTION_VARIATION_SET = 43
CONFIRMATION_VARIATION_SET = 44
VARIATION_SETS = (REPORTED_VARIATION_SET, SELECTION_VARIATION_SET, CONFIRMATION_VARIATION_SET)
MAX_EPISODE_STEPS = 500
FPS = 80  # one environment step is 0.0125 s of simulated time
ACTION_DIM = 4  # x, y, z, gripper, each in [-1, 1]
STATE_DIM = 4  # Cartesian end effector (m) and gripper opening
ENV_STATE_DIM = 39
IMAGE_SIZE = 64
ROBOT_TYPE = "metaworld"

# The default camera is LeRobot's adjusted corner2, which shows the objects of every task.
CAMERA_NAME = "corner2"
CAMERA_POSITION = (0.75, 0.075, 0.7)

# Files that one command writes and others read.
RECORDS_NAME = "records.jsonl"  # one line per rollout
QUALITY_NAME = "quality.json"
EVAL_INFO_NAME = "eval_info.json"
TRAIN_LOG_NAME = "train_log.jsonl"
