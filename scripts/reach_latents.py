"""Whether a world model's latents hold reach's goal because it was seen, or because the demonstrator's actions told it.

    python scripts/reach_latents.py --demonstrations=outputs/best/seed_0/latents_wm_rssm --others=LATENTS_OF_SET_43 \
        --output=results/analysis/reach_latents.json

Both are latent datasets of the same world model (`lerobot-wm encode`): the demonstrations of the variations that are
trained on, and demonstrations of the 50 variations of set 43. A linear regression reads the goal's place from the hand.
At an episode's first frame the goal is in the image and no action has been made: what is read there was seen. Later
frames follow actions, each of which is the demonstrator's way to the goal and noise. Seconds on one core.
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

PENALTY = 1e-2  # of the ridge regression, per frame and for features of unit variance
FRAMES = ((0, 1), (1, 2), (2, 4), (4, 8), (8, 16), (16, 30), (30, 60))  # of an episode: from, to before


@dataclass(frozen=True)
class Frames:
    """Reach's frames of a dataset.

    Args:
        latents: s_t, (N, L).
        blind: What a policy knows that sees nothing: the hand's place, the frame's number, and their squares, (N, 8).
        way: From the hand to the goal (cm), (N, 3).
        numbers: How many frames into its episode each is, (N,).
    """

    latents: Tensor
    blind: Tensor
    way: Tensor
    numbers: Tensor


def read(root: Path) -> Frames:
    """Reach's frames of a latent dataset."""
    dataset = LeRobotDataset("local/reach", root=root)
    table = dataset.hf_dataset.with_format("numpy")
    of_task = table["task_index"][:] == dataset.meta.tasks.loc[task_description(TASK), "task_index"]

    def column(key: str) -> Tensor:
        return torch.as_tensor(np.stack(table[key][:])[of_task]).float()

    states, numbers = column(OBS_ENV_STATE), column("frame_index")
    known = torch.cat([states[:, HAND], numbers[:, None]], dim=1)  # (N, 4)
    way = 100 * (states[:, GOAL] - states[:, HAND])
    return Frames(column(OBS_LATENT), torch.cat([known, known**2], dim=1), way, numbers)


def reading(x: Tensor, y: Tensor, others: Tensor) -> Tensor:
    """`y` (N, 3) for others (M, F), by a ridge regression fitted to features x (N, F)."""
    regression = make_pipeline(StandardScaler(), Ridge(PENALTY * len(x))).fit(x.numpy(), y.numpy())
    return torch.as_tensor(regression.predict(others.numpy()))


def main() -> None:
    """Print and write the table."""
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("--demonstrations", type=Path, required=True, help="latents that are learned from")
    parser.add_argument("--others", type=Path, required=True, help="latents of other goals")
    parser.add_argument("--output", type=Path, required=True)
    arguments = parser.parse_args()
    register_third_party_plugins()
    worlds = {
        LatentRecord.read(root).world_model_fingerprint
        for root in (arguments.demonstrations, arguments.others)
    }
    if len(worlds) > 1:
        parser.error("the two latent datasets are of different world models: encode both with the same")
    known, others = read(arguments.demonstrations), read(arguments.others)
    errors = {
        "latents": reading(known.latents, known.way, others.latents) - others.way,  # (M, 3)
        "blind": reading(known.blind, known.way, others.blind) - others.way,
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
