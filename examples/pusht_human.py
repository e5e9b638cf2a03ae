"""Turn people's PushT demonstrations, as Diffusion Policy stores them, into a LeRobotDataset.

    python examples/pusht_human.py --file=pusht_human.npz --repo_id=me/pusht_human --root=data/pusht_human

The Hub's `lerobot/pusht` holds the same demonstrations; this copy adds the block's corners as
`observation.environment_state`, which `--env.obs_type=environment_state_agent_pos` gives a policy, and the reward.
"""

from dataclasses import dataclass
from pathlib import Path

import draccus
import numpy as np
from gym_pusht.envs.pusht import PushTEnv
from lerobot.datasets.lerobot_dataset import LeRobotDataset
from tqdm import tqdm

TASK = "Push the T-shaped block onto the T-shaped target."
FPS = 10
FEATURES = {
    "observation.image": {"dtype": "video", "shape": (96, 96, 3), "names": ["height", "width", "channels"]},
    "observation.state": {"dtype": "float32", "shape": (2,), "names": ["x", "y"]},
    "observation.environment_state": {"dtype": "float32", "shape": (16,), "names": None},
    "action": {"dtype": "float32", "shape": (2,), "names": ["x", "y"]},
    "next.reward": {"dtype": "float32", "shape": (1,), "names": None},
    "next.success": {"dtype": "bool", "shape": (1,), "names": None},
    "next.done": {"dtype": "bool", "shape": (1,), "names": None},
}


@dataclass
class ConvertConfig:
    """What to convert, and where to."""

    # With the arrays image, state, action and episode_ends of Diffusion Policy's pusht_cchi_v7_replay.zarr.
    file: Path
    # Name of the dataset, as user/name.
    repo_id: str
    # Its folder, which must not exist.
    root: Path


def main() -> None:
    """Convert."""
    cfg = draccus.parse(ConvertConfig)
    arrays = np.load(cfg.file)
    image, state, action = (arrays[name] for name in ("image", "state", "action"))
    env = PushTEnv(obs_type="environment_state_agent_pos")
    env.reset(seed=0)
    dataset = LeRobotDataset.create(cfg.repo_id, FPS, FEATURES, cfg.root, image_writer_threads=2)
    begin = 0
    for end in tqdm(arrays["episode_ends"], unit="episode"):
        corners, coverage = [], []
        for frame in range(begin, end):
            # The angle first: it turns the block about its centre of mass, and so moves it.
            env.block.angle = float(state[frame, 4])
            env.block.position = tuple(state[frame, 2:4].astype(float))
            corners.append(env.get_obs()["environment_state"].astype(np.float32))
            coverage.append(env._get_coverage())
        # A demonstration ends when the person was satisfied; the state after its last action was not recorded.
        following = np.append(coverage[1:], coverage[-1])
        for i, frame in enumerate(range(begin, end)):
            success = following[i] > env.success_threshold
            dataset.add_frame(
                {
                    "observation.image": image[frame],
                    "observation.state": state[frame, :2],
                    "observation.environment_state": corners[i],
                    "action": action[frame],
                    "next.reward": np.float32([min(following[i] / env.success_threshold, 1)]),
                    "next.success": np.array([success]),
                    "next.done": np.array([success]),
                    "task": TASK,
                }
            )
        dataset.save_episode()
        begin = end
    dataset.finalize()


if __name__ == "__main__":
    main()
