"""Environment steps with image per second: metaworld_mt at 64x64 against LeRobot's metaworld at its 480x480.

    python benchmarks/env_speed.py > rows.json

Both run in this process on one task at a time, alternating, so that a busy machine slows both; the median of
the repeats counts. Prints one JSON row per task and one over all.
"""

import json
import statistics
import time
from typing import Any

import gymnasium as gym
import numpy as np

from lerobot_wm.constants import MT6
from lerobot_wm.envs.metaworld_mt import MetaworldMTEnv  # before metaworld: it chooses the OpenGL backend

OUR_STEPS, PEER_STEPS, REPEATS = 60, 6, 5


def steps_per_second(env: gym.Env, steps: int) -> float:
    """Speed of `steps` steps with observations, after a reset, under small random actions."""
    env.reset(seed=0)
    actions = np.random.default_rng(0).uniform(-0.2, 0.2, (steps, 4)).astype(np.float32)
    start = time.perf_counter()
    for action in actions:
        env.step(action)
    return steps / (time.perf_counter() - start)


def row(task: str, ours: float, peer: float) -> dict[str, Any]:
    """One result, in the form of results/benchmarks."""
    return {
        "row": f"env steps with image, {task}",
        "ours": round(ours, 1),
        "peer": round(peer, 2),
        "peer_name": "lerobot 0.6.1 metaworld",
        "ratio": round(ours / peer, 1),
        "unit": "steps/s",
        "sizes": {"ours": "64x64", "peer": "480x480", "repeats": REPEATS},
    }


def main() -> None:
    """Measure the six tasks and print the rows."""
    from lerobot.envs.metaworld import MetaworldEnv

    rows = []
    speeds: list[tuple[float, float]] = []
    for task in MT6:
        our_env, peer_env = MetaworldMTEnv(task), MetaworldEnv(task, obs_type="pixels_agent_pos")
        steps_per_second(our_env, 2)  # builds models and contexts
        steps_per_second(peer_env, 2)
        repeats = [
            (steps_per_second(our_env, OUR_STEPS), steps_per_second(peer_env, PEER_STEPS))
            for _ in range(REPEATS)
        ]
        ours, peer = (statistics.median(column) for column in zip(*repeats, strict=True))
        rows.append(row(task, ours, peer))
        speeds.append((ours, peer))
        our_env.close()
        peer_env.close()
    means = [statistics.harmonic_mean(column) for column in zip(*speeds, strict=True)]
    rows.append(row("mt6 (harmonic mean)", *means))
    print(json.dumps(rows, indent=1))


if __name__ == "__main__":
    main()
