"""MT50: how exactly can an encoder tell where objects and goals are, at positions that it has not seen?

    python results/mt50/positions.py --root=data/positions --image_size=128 --n_keypoints=64

Trains the encoder of the world model on the simulator's numbers: demonstrations on variations 0-39 of each task. Prints
the error on variations 40-49 in cm. The network is told the task, as a policy is.
"""

import argparse

import numpy as np
import torch
from lerobot.datasets.lerobot_dataset import LeRobotDataset
from torch import Tensor, nn
from torch.nn import functional as F

from lerobot_wm.constants import OBS_ENV_STATE, VARIATION
from lerobot_wm.encode.episodes import read_episodes
from lerobot_wm.nn.conv import make_encoder
from lerobot_wm.nn.images import random_crop
from lerobot_wm.nn.mlp import MLP
from lerobot_wm.nn.normalize import Affine

FIRST_HELD_OUT = 40
BATCH = 64
# Places in Meta-World's full state, (x, y, z) each.
TARGETS = {"hand": slice(0, 3), "object": slice(4, 7), "second object": slice(11, 14), "goal": slice(36, 39)}


def main() -> None:
    """Train, and print the errors."""
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("--root", required=True)
    parser.add_argument("--image_size", type=int, default=64)
    parser.add_argument("--n_keypoints", type=int, default=0)
    parser.add_argument("--shift", type=int, default=0)
    parser.add_argument("--steps", type=int, default=6000)
    arguments = parser.parse_args()
    torch.set_num_threads(1)
    torch.manual_seed(0)
    dataset = LeRobotDataset("local/positions", arguments.root)
    size = arguments.image_size
    columns = [OBS_ENV_STATE, VARIATION]
    episodes = read_episodes(dataset, dataset.meta.camera_keys, (size, size), columns=columns)
    tasks = sorted({each.task for each in episodes})
    task = torch.cat([torch.full((len(each),), tasks.index(each.task)) for each in episodes])  # (N,)
    state = torch.cat([each.columns[OBS_ENV_STATE] for each in episodes]).float()  # (N, 39)
    places = torch.cat([state[:, part] for part in TARGETS.values()], dim=1)  # (N, 12)
    held_out = torch.cat([each.columns[VARIATION].flatten() for each in episodes]) >= FIRST_HELD_OUT  # (N,)
    frames = [(episode, t) for episode in range(len(episodes)) for t in range(len(episodes[episode]))]
    learned = torch.nonzero(~held_out).flatten()

    encoder = make_encoder(3 * len(dataset.meta.camera_keys), size, arguments.n_keypoints)
    head = MLP(encoder.embed_dim + len(tasks), [256, 256], places.shape[1], nn.ReLU)
    model = nn.ModuleList([encoder, head])
    targets = Affine(places.shape[1])
    targets.set_standard(places.mean(0), places.std(0).clamp(min=1e-3))

    def images(rows: Tensor) -> Tensor:
        chosen = [frames[row] for row in rows.tolist()]
        return torch.cat([episodes[episode].images([t]) for episode, t in chosen]) - 0.5  # (B, C, S, S)

    def predict(rows: Tensor, shift: int = 0) -> Tensor:
        with torch.autocast("cpu", torch.bfloat16):
            seen = images(rows)
            features = encoder(random_crop(seen, shift) if shift else seen)
        return head(torch.cat([features.float(), F.one_hot(task[rows], len(tasks)).float()], dim=1))

    optimizer = torch.optim.AdamW(model.parameters(), 1e-3, weight_decay=1e-4)
    schedule = torch.optim.lr_scheduler.OneCycleLR(optimizer, 1e-3, arguments.steps)
    for _ in range(arguments.steps):
        rows = learned[torch.randint(len(learned), (BATCH,))]
        loss = (predict(rows, arguments.shift) - targets(places[rows])).abs().mean()
        optimizer.zero_grad()
        loss.backward()
        optimizer.step()
        schedule.step()

    model.eval()
    with torch.inference_mode():
        found = torch.cat([targets.inverse(predict(rows)) for rows in torch.arange(len(task)).split(256)])
    error = 100 * (found - places).view(len(task), -1, 3).norm(dim=2).numpy()  # (N, 4) cm
    print(
        f"{size} pixels, {arguments.n_keypoints} keypoints, {arguments.shift} shift, {arguments.steps} steps"
    )
    for name, chosen in (("learned", ~held_out), ("held out", held_out)):
        for number, sentence in enumerate(tasks):
            of_task = error[(chosen & (task == number)).numpy()]
            cells = ", ".join(f"{target} {np.median(of_task[:, i]):.2f}" for i, target in enumerate(TARGETS))
            print(f"{name}, {sentence}: {cells} cm", flush=True)


if __name__ == "__main__":
    main()
