"""ALOHA's cube transfer with and without images: how good is the policy if it is told where the cube is?

    python results/aloha/aloha.py add_cube --root=data/aloha --output=data/aloha_state
    python results/aloha/aloha.py evaluate --policy=outputs/aloha_bc/checkpoints/last/pretrained_model --output=bc.json

`add_cube` copies the demonstrations of examples/record_env.py with the cube's pose, which it finds by replaying them.
`evaluate` rolls out a policy on images or on that pose. LeRobot's environment renders three cameras at every step and
passes on one; here only this one is rendered, and none for a policy without images. The starts are those of
`lerobot-eval --seed=1000`.
"""

import argparse
import json
from pathlib import Path
from typing import Any

import gym_aloha  # noqa: F401  # registers the environment
import gymnasium as gym
import numpy as np
import torch
from lerobot.configs import PreTrainedConfig
from lerobot.datasets.compute_stats import get_feature_stats
from lerobot.datasets.dataset_tools import add_features
from lerobot.datasets.io_utils import write_stats
from lerobot.datasets.lerobot_dataset import LeRobotDataset
from lerobot.policies.factory import get_policy_class, make_pre_post_processors
from lerobot.utils.import_utils import register_third_party_plugins

from lerobot_wm.constants import ACTION, OBS_ENV_STATE, OBS_STATE
from lerobot_wm.records import provenance

CAMERA = "top"
MAX_STEPS = 400  # LeRobot's episode_length of ALOHA
SUCCESS_REWARD = 4  # the left gripper holds the cube, and it does not touch the table


def make_env(*, renders: bool) -> Any:
    """The environment, which renders one camera or none."""
    env = gym.make("gym_aloha/AlohaTransferCube-v0", obs_type="pixels_agent_pos").unwrapped
    physics = env._env.physics
    render, black = physics.render, np.zeros((1, 1, 3), np.uint8)
    physics.render = lambda camera_id, **size: (
        render(camera_id=camera_id, **size) if renders and camera_id == CAMERA else black
    )
    return env


def cube(env: Any) -> np.ndarray:
    """Place (m) and orientation (quaternion) of the cube, (7,) float32."""
    return env._env.physics.data.qpos[16:].astype(np.float32)


def add_cube(root: Path, output: Path) -> None:
    """Copy demonstrations, whose episode i was recorded from seed i, with the cube's pose."""
    data, env, poses = LeRobotDataset("demonstrations/aloha", root), make_env(renders=False), []
    columns = data.hf_dataset.with_format("numpy")[:]
    episodes, actions, states = (np.stack(columns[key]) for key in ("episode_index", ACTION, OBS_STATE))
    for episode in range(data.meta.total_episodes):
        observation, _ = env.reset(seed=episode)
        for t in np.flatnonzero(episodes == episode):
            np.testing.assert_allclose(observation["agent_pos"], states[t], atol=1e-4)
            poses.append(cube(env))
            observation, *_ = env.step(actions[t])
    feature = {"dtype": "float32", "shape": (7,), "names": None}
    values = np.array(poses)  # (frames, 7)
    copy = add_features(data, {OBS_ENV_STATE: (values, feature)}, output, "demonstrations/aloha_state")
    write_stats({**copy.meta.stats, OBS_ENV_STATE: get_feature_stats(values, axis=0, keepdims=False)}, output)


def evaluate(path: str, first_start: int, n_episodes: int) -> list[dict[str, Any]]:
    """Roll a policy out; one entry per start: its seed, the highest reward and the number of steps."""
    register_third_party_plugins()
    torch.set_num_threads(1)
    config = PreTrainedConfig.from_pretrained(path)
    config.device = "cpu"
    policy = get_policy_class(config.type).from_pretrained(path, config=config)
    before, after = make_pre_post_processors(config, path)
    env = make_env(renders=bool(config.image_features))
    rollouts = []
    for seed in range(first_start, first_start + n_episodes):
        observation, _ = env.reset(seed=seed)
        policy.reset()
        best, steps = 0, 0
        while steps < MAX_STEPS and best < SUCCESS_REWARD:
            frame = {
                f"observation.images.{CAMERA}": torch.from_numpy(
                    observation["pixels"][CAMERA].transpose(2, 0, 1) / np.float32(255)
                ),
                OBS_STATE: torch.from_numpy(observation["agent_pos"]).float(),
                OBS_ENV_STATE: torch.from_numpy(cube(env)),
                "task": "",
            }
            kept = {key: value for key, value in frame.items() if key in (*config.input_features, "task")}
            with torch.inference_mode():
                action = after(policy.select_action(before(kept)))
            observation, reward, *_ = env.step(action.squeeze(0).numpy())
            best, steps = max(best, int(reward)), steps + 1
        rollouts.append({"start": seed, "reward": best, "steps": steps})
        print(rollouts[-1], flush=True)
    return rollouts


def main() -> None:
    """Read the arguments and run what they ask for."""
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    commands = parser.add_subparsers(dest="command", required=True)
    adding = commands.add_parser("add_cube")
    adding.add_argument("--root", type=Path, required=True)
    adding.add_argument("--output", type=Path, required=True)
    evaluating = commands.add_parser("evaluate")
    evaluating.add_argument("--policy", required=True)
    evaluating.add_argument("--output", type=Path, required=True)
    evaluating.add_argument("--first_start", type=int, default=1000)
    evaluating.add_argument("--n_episodes", type=int, default=50)
    arguments = parser.parse_args()
    if arguments.command == "add_cube":
        add_cube(arguments.root, arguments.output)
        return
    rollouts = evaluate(arguments.policy, arguments.first_start, arguments.n_episodes)
    record = {"policy": arguments.policy, "provenance": provenance(), "rollouts": rollouts}
    arguments.output.write_text(json.dumps(record) + "\n")
    print(sum(each["reward"] == SUCCESS_REWARD for each in rollouts), "of", len(rollouts))


if __name__ == "__main__":
    main()
