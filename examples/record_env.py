"""Record a LeRobotDataset in one of LeRobot's simulated environments, acted in by a script.

    python examples/record_env.py --env.type=pusht --repo_id=me/pusht --root=data/pusht --n_episodes=200

PushT's block is pushed towards its goal by a rule of thumb that often succeeds. ALOHA's arms hand over the cube
(--env.task=AlohaTransferCube-v0) by a plan that nearly always does.

Frames hold what `lerobot-eval` gives a policy, under the same keys, and the reward, success and end that the action
leads to, as in the Meta-World data of `lerobot-wm collect`.
"""

from dataclasses import dataclass
from pathlib import Path
from typing import Any

import gymnasium as gym
import numpy as np
from env_scripts import SCRIPTS, Script
from lerobot.configs import parser
from lerobot.configs.video import RGBEncoderConfig
from lerobot.datasets.lerobot_dataset import LeRobotDataset
from lerobot.envs import make_env, make_env_pre_post_processors, preprocess_observation
from lerobot.envs.configs import EnvConfig
from tqdm import trange

from lerobot_wm.system import quiet


@dataclass
class RecordConfig:
    """What to record, and where."""

    # The environment, as lerobot-eval takes it: --env.type=pusht or aloha, --env.task, --env.episode_length.
    env: EnvConfig
    # Name of the dataset, as user/name.
    repo_id: str
    # Its folder, which must not exist.
    root: Path
    # Episodes to record; all are kept, failures too.
    n_episodes: int = 100
    # The environment's seed in the first episode, one more in each that follows. lerobot-eval begins at 1000.
    seed: int = 0


def task_string(env: gym.vector.VectorEnv, env_config: EnvConfig) -> str:
    """The environment's own words for its task, looked for as lerobot-eval does; without any, its name."""
    for attribute in ("task_description", "task"):
        try:
            return str(env.call(attribute)[0])
        except AttributeError:
            continue
    return str(env_config.task)


def to_frame(raw: dict[str, Any], process: Any) -> dict[str, np.ndarray]:
    """What lerobot-eval gives a policy, as a dataset holds it: images (H, W, C) uint8, vectors (N,) float32.

    Args:
        raw: The observation of one environment, as it emits it.
        process: LeRobot's processor of the environment's observations.
    """
    frame = {}
    for key, value in process(preprocess_observation(raw)).items():
        if not key.startswith("observation."):
            continue
        if value.ndim == 4:  # (1, C, H, W) in [0, 1]
            frame[key] = (255 * value[0]).round().byte().permute(1, 2, 0).numpy()
        else:
            frame[key] = value[0].numpy()
    return frame


def features(frame: dict[str, np.ndarray], action_dim: int) -> dict[str, dict[str, Any]]:
    """LeRobot's description of a dataset of such frames."""
    described: dict[str, dict[str, Any]] = {
        key: {"dtype": "video", "shape": value.shape, "names": ["height", "width", "channels"]}
        if value.ndim == 3
        else {"dtype": "float32", "shape": value.shape, "names": None}
        for key, value in frame.items()
    }
    for key, dtype, size in (
        ("action", "float32", action_dim),
        ("next.reward", "float32", 1),
        ("next.success", "bool", 1),
        ("next.done", "bool", 1),
    ):
        described[key] = {"dtype": dtype, "shape": (size,), "names": None}
    return described


def record_episode(
    env: gym.vector.SyncVectorEnv, process: Any, script_type: type[Script], seed: int
) -> list[dict[str, Any]]:
    """The frames of one episode.

    Args:
        env: One environment, as LeRobot makes it.
        process: LeRobot's processor of its observations.
        script_type: Makes what acts in it.
        seed: Of the environment and of the script.
    """
    frames = []
    raw, info = env.reset(seed=[seed])
    script = script_type(np.random.default_rng(seed), env.envs[0].unwrapped)
    ended = False
    while not ended:
        frame = to_frame(raw, process)
        action = script(frame["observation.state"].astype(float), info).astype(np.float32)
        raw, reward, terminated, truncated, info = env.step(action[None])
        ended = bool(terminated[0] or truncated[0])
        # With the last step the environment starts again, and its info is of the next episode.
        result = info["final_info"] if ended else info
        frame |= {
            "action": action,
            "next.reward": reward.astype(np.float32),
            "next.success": np.array([result["is_success"][0]], dtype=bool),
            "next.done": terminated.copy(),  # a time limit ends the recording, not the task
        }
        frames.append(frame)
    return frames


@parser.wrap()
def record(config: RecordConfig) -> None:
    """Record the dataset.

    Raises:
        ValueError: There is no script for the environment's task in env_scripts.py.
        FileExistsError: The dataset's folder is there already.
    """
    if config.env.task not in SCRIPTS:
        raise ValueError(
            f"--env.task={config.env.task} has no script in examples/env_scripts.py, which has {', '.join(SCRIPTS)}: "
            "add one, or record what a policy does, by `lerobot-eval --eval.recording=true`."
        )
    if config.root.exists():
        raise FileExistsError(f"{config.root} is there already: choose another --root, or remove it.")
    env = make_env(config.env)[config.env.type][0]
    process, _ = make_env_pre_post_processors(config.env, policy_cfg=None)
    task = task_string(env, config.env)
    first, _ = env.reset(seed=[config.seed])
    dataset = LeRobotDataset.create(
        config.repo_id,
        fps=config.env.fps,
        root=config.root,
        robot_type=config.env.type,
        features=features(to_frame(first, process), env.single_action_space.shape[0]),
        # LeRobot's default halves the resolution of colour, in which small things are lost; with x264's mbtree the same
        # frames do not always give the same video.
        rgb_encoder=RGBEncoderConfig(vcodec="h264", pix_fmt="yuv444p", crf=10, extra_options={"mbtree": 0}),
    )
    successes = 0
    try:
        with quiet():  # else the video encoder reports on every episode
            progress = trange(config.n_episodes, unit="episode")
            for episode in progress:
                seed = config.seed + episode
                frames = record_episode(env, process, SCRIPTS[config.env.task], seed)
                for frame in frames:
                    dataset.add_frame({**frame, "task": task})
                dataset.save_episode()
                successes += int(frames[-1]["next.success"][0])
                progress.set_postfix(successes=successes)
    finally:
        dataset.finalize()  # without which nothing of it can be read
        env.close()
    print(f"{config.root}: {config.n_episodes} episodes of '{task}', {successes} of them successes")


if __name__ == "__main__":
    record()
