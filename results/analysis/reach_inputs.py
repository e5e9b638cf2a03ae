"""Which exact inputs let imitation of reach generalise from ten goals to all fifty.

    python results/analysis/reach_inputs.py --dataset=outputs/cpu/dataset --output=results/analysis/reach_inputs.json

For each set of inputs, taken from the simulator's state, a small network imitates reach's demonstrations by squared
error. It is then rolled out on the 50 variations of set 43 with Gaussian noise on its actions. Nothing is rendered, so
this takes minutes on one core.
"""

import argparse
import json
from collections.abc import Callable
from pathlib import Path

import numpy as np
import torch
from lerobot.datasets.lerobot_dataset import LeRobotDataset
from lerobot.utils.import_utils import register_third_party_plugins
from torch import Tensor, nn

from lerobot_wm.constants import (
    ACTION,
    MAX_EPISODE_STEPS,
    NUM_VARIATIONS,
    OBS_ENV_STATE,
    SELECTION_VARIATION_SET,
)
from lerobot_wm.envs.simulation import Simulation
from lerobot_wm.envs.tasks import task_description
from lerobot_wm.nn.mlp import MLP
from lerobot_wm.records import provenance

TASK = "reach-v3"
NOISES = (0.0, 0.3, 0.5)
STEPS, BATCH_SIZE, LR = 4000, 256, 1e-3

# Meta-World's state: hand (m), gripper opening, puck, ...; the same one step ago; the goal (envs/simulation.py).
HAND, GRIPPER, PUCK, GOAL = slice(0, 3), slice(3, 4), slice(4, 7), slice(36, 39)


def concatenate(*parts: Tensor) -> Tensor:
    """Concatenate parts (..., n_i) along their last dimension."""
    return torch.cat(parts, dim=-1)


INPUTS: dict[str, Callable[[Tensor], Tensor]] = {
    "goal from the hand": lambda s: s[..., GOAL] - s[..., HAND],
    "goal, hand and gripper": lambda s: concatenate(s[..., GOAL], s[..., HAND], s[..., GRIPPER]),
    "goal and puck from the hand": lambda s: concatenate(
        s[..., GOAL] - s[..., HAND], s[..., PUCK] - s[..., HAND]
    ),
    "goal, puck, hand and gripper": lambda s: concatenate(
        s[..., GOAL], s[..., PUCK], s[..., HAND], s[..., GRIPPER]
    ),
    "all 39 numbers": lambda s: s,
    "hand and gripper (blind)": lambda s: concatenate(s[..., HAND], s[..., GRIPPER]),
}


def read_demonstrations(root: Path) -> tuple[Tensor, Tensor]:
    """Return states (N, 39) and actions (N, 4) of reach's demonstrations."""
    dataset = LeRobotDataset("local/reach", root=root)
    frames = dataset.hf_dataset.with_format("numpy")
    of_task = frames["task_index"][:] == dataset.meta.tasks.loc[task_description(TASK), "task_index"]
    states, actions = (np.stack(frames[key][:])[of_task] for key in (OBS_ENV_STATE, ACTION))
    return torch.as_tensor(states, dtype=torch.float32), torch.as_tensor(actions, dtype=torch.float32)


def imitate(x: Tensor, actions: Tensor) -> Callable[[Tensor], Tensor]:
    """Fit a policy by squared error to inputs (N, I) and actions (N, A)."""
    torch.manual_seed(0)
    mean, std = x.mean(0), x.std(0) + 1e-6
    network = MLP(x.shape[1], [256, 256], actions.shape[1], activation=nn.ReLU)
    optimizer = torch.optim.Adam(network.parameters(), lr=LR)
    schedule = torch.optim.lr_scheduler.CosineAnnealingLR(optimizer, STEPS)
    for _ in range(STEPS):
        batch = torch.randint(len(x), (BATCH_SIZE,))
        loss = nn.functional.mse_loss(network((x[batch] - mean) / std), actions[batch])
        optimizer.zero_grad()
        loss.backward()
        optimizer.step()
        schedule.step()
    return lambda inputs: network((inputs - mean) / std).clamp(-1, 1)


@torch.no_grad()
def count_successes(
    simulation: Simulation,
    policy: Callable[[Tensor], Tensor],
    inputs: Callable[[Tensor], Tensor],
    noise: float,
) -> int:
    """Count the goals that the policy reaches on the 50 variations."""
    rng = np.random.default_rng(0)
    reached = 0
    for variation in range(NUM_VARIATIONS):
        state = simulation.reset(variation)
        for _ in range(MAX_EPISODE_STEPS):
            action = policy(inputs(torch.as_tensor(state, dtype=torch.float32)[None]))[0].numpy()  # (4,)
            action = np.clip(action + noise * rng.standard_normal(action.shape), -1, 1)
            state, _, success = simulation.step(action)
            if success:
                reached += 1
                break
    return reached


def main() -> None:
    """Measure all inputs, print the table and write it as JSON."""
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("--dataset", type=Path, required=True, help="folder of the mt6 demonstrations")
    parser.add_argument("--output", type=Path, required=True)
    arguments = parser.parse_args()
    register_third_party_plugins()
    states, actions = read_demonstrations(arguments.dataset)
    simulation = Simulation(TASK, SELECTION_VARIATION_SET)
    rows = {}
    for name, inputs in INPUTS.items():
        policy = imitate(inputs(states), actions)
        rows[name] = {
            f"noise {noise}": count_successes(simulation, policy, inputs, noise) for noise in NOISES
        }
        print(f"{name:30s} {rows[name]}", flush=True)
    arguments.output.parent.mkdir(parents=True, exist_ok=True)
    arguments.output.write_text(
        json.dumps({"rows": rows, "rollouts": NUM_VARIATIONS, "provenance": provenance()}, indent=2) + "\n"
    )


if __name__ == "__main__":
    main()
