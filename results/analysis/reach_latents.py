"""Do latents know reach's goal from the images, or from the demonstrator's actions?

    python results/analysis/reach_latents.py --demonstrations=LATENTS --others=LATENTS_OF_SET_43 \
        --output=results/analysis/reach_latents.json

Both flags name latent datasets that `lerobot-wm encode` made with the same world model: of the training demonstrations,
and of demonstrations on the 50 variations of set 43. A linear regression predicts the vector from the hand to the goal.
At an episode's first frame no action has been taken, so whatever the regression finds there comes from the image. Later
frames follow actions, and each action is the demonstrator's way to the goal plus noise. Takes seconds on one core.
"""

import argparse
import json
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import torch
from lerobot.datasets.lerobot_dataset import LeRobotDataset
from lerobot.utils.import_utils import register_third_party_plugins
from reach_inputs import GOAL, HAND, TASK
from sklearn.linear_model import Ridge
from sklearn.pipeline import make_pipeline
from sklearn.preprocessing import StandardScaler
from torch import Tensor

from lerobot_wm.constants import OBS_ENV_STATE, OBS_LATENT
from lerobot_wm.data.latents import LatentRecord
from lerobot_wm.envs.tasks import task_description
from lerobot_wm.records import provenance

PENALTY = 1e-2  # Of the ridge regression, per frame, for features of unit variance.
FRAMES = ((0, 1), (1, 2), (2, 4), (4, 8), (8, 16), (16, 30), (30, 60))  # of an episode: from, to before


@dataclass(frozen=True)
class Frames:
    """Reach's frames of a dataset.

    Args:
        latents: s_t, (N, L).
        blind: What a blind policy knows: hand position, frame number, and their squares, (N, 8).
        way: Vector from the hand to the goal in cm, (N, 3).
        numbers: Index of each frame in its episode, (N,).
    """

    latents: Tensor
    blind: Tensor
    way: Tensor
    numbers: Tensor


def read(root: Path) -> Frames:
    """Read reach's frames of a latent dataset."""
    dataset = LeRobotDataset("local/reach", root=root)
    table = dataset.hf_dataset.with_format("numpy")
    of_task = table["task_index"][:] == dataset.meta.tasks.loc[task_description(TASK), "task_index"]

    def column(key: str) -> Tensor:
        return torch.as_tensor(np.stack(table[key][:])[of_task]).float()

    states, numbers = column(OBS_ENV_STATE), column("frame_index")
    known = torch.cat([states[:, HAND], numbers[:, None]], dim=1)  # (N, 4)
    way = 100 * (states[:, GOAL] - states[:, HAND])
    return Frames(column(OBS_LATENT), torch.cat([known, known**2], dim=1), way, numbers)


def predict(x: Tensor, y: Tensor, others: Tensor) -> Tensor:
    """Predict targets (M, 3) for `others` (M, F) by ridge regression from features x (N, F) to y (N, 3)."""
    regression = make_pipeline(StandardScaler(), Ridge(PENALTY * len(x))).fit(x.numpy(), y.numpy())
    return torch.as_tensor(regression.predict(others.numpy()))


def main() -> None:
    """Measure all frame ranges, print the table and write it as JSON."""
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("--demonstrations", type=Path, required=True, help="latents to fit on")
    parser.add_argument("--others", type=Path, required=True, help="latents of other goals")
    parser.add_argument("--output", type=Path, required=True)
    arguments = parser.parse_args()
    register_third_party_plugins()
    worlds = {
        LatentRecord.read(root).world_model_fingerprint
        for root in (arguments.demonstrations, arguments.others)
    }
    if len(worlds) > 1:
        parser.error(
            "The two latent datasets come from different world models. Encode both with the same one."
        )
    known, others = read(arguments.demonstrations), read(arguments.others)
    errors = {
        "latents": predict(known.latents, known.way, others.latents) - others.way,  # (M, 3)
        "blind": predict(known.blind, known.way, others.blind) - others.way,
    }
    rows = {}
    for start, stop in FRAMES:
        chosen = (others.numbers >= start) & (others.numbers < stop)
        name = f"{start}" if stop == start + 1 else f"{start}-{stop - 1}"
        rows[name] = {who: round(error[chosen].norm(dim=1).mean().item(), 2) for who, error in errors.items()}
        print(f"frames {name:6s} {rows[name]}", flush=True)
    arguments.output.parent.mkdir(parents=True, exist_ok=True)
    arguments.output.write_text(
        json.dumps({"rows": rows, "unit": "cm", "provenance": provenance()}, indent=2) + "\n"
    )


if __name__ == "__main__":
    main()
