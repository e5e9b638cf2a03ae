"""MT50: how exactly can an encoder tell where objects and goals are, at positions that it has not seen?

    python results/mt50/positions.py --root=data/positions --image_size=128 --n_keypoints=64
    python results/mt50/positions.py --root=outputs/mt50_hand/dataset --tasks=reach-v3 --from_hand --scale=channels

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
from lerobot_wm.envs.tasks import resolve_tasks, task_description
from lerobot_wm.nn.conv import make_encoder
from lerobot_wm.nn.images import random_crop
from lerobot_wm.nn.mlp import MLP
from lerobot_wm.nn.normalize import Affine

FIRST_HELD_OUT = 40
BATCH = 64
SAMPLE = 4000  # frames of which images are scaled
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
    parser.add_argument("--tasks", help="all unless some are named")
    parser.add_argument("--from_hand", action="store_true", help="learn places relative to the hand")
    parser.add_argument(
        "--scale",
        choices=("channels", "pixels"),
        help="by mean and standard deviation of each; else only by 0.5",
    )
    arguments = parser.parse_args()
    torch.set_num_threads(1)
    torch.manual_seed(0)
    dataset = LeRobotDataset("local/positions", arguments.root)
    if arguments.tasks:
        wanted = {task_description(task) for task in resolve_tasks(arguments.tasks)}
        of_tasks = [i for i, tasks in enumerate(dataset.meta.episodes["tasks"]) if tasks[0] in wanted]
        dataset = LeRobotDataset("local/positions", arguments.root, episodes=of_tasks)
    size = arguments.image_size
    columns = [OBS_ENV_STATE, VARIATION]
    episodes = read_episodes(dataset, dataset.meta.camera_keys, (size, size), columns=columns)
    tasks = sorted({each.task for each in episodes})
    task = torch.cat([torch.full((len(each),), tasks.index(each.task)) for each in episodes])  # (N,)
    state = torch.cat([each.columns[OBS_ENV_STATE] for each in episodes]).float()  # (N, 39)
    places = torch.cat([state[:, part] for part in TARGETS.values()], dim=1)  # (N, 12)
    if arguments.from_hand:
        places[:, 3:] -= places[:, :3].repeat(1, 3)
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
        return torch.cat([episodes[episode].images([t]) for episode, t in chosen])  # (B, C, S, S)

    offset, scale = torch.tensor(0.5), torch.tensor(1.0)
    if arguments.scale:
        sample = images(learned[torch.randint(len(learned), (SAMPLE,))])
        over = (0, 2, 3) if arguments.scale == "channels" else (0,)
        offset, scale = sample.mean(over, keepdim=True), sample.std(over, keepdim=True).clamp(min=0.02)

    def predict(rows: Tensor, shift: int = 0) -> Tensor:
        with torch.autocast("cpu", torch.bfloat16):
            seen = (images(rows) - offset) / scale
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
        f"{size} pixels, {arguments.n_keypoints} keypoints, {arguments.shift} shift, {arguments.steps} steps, "
        f"scaled: {arguments.scale}, from the hand: {arguments.from_hand}"
    )
    for name, chosen in (("learned", ~held_out), ("held out", held_out)):
        for number, sentence in enumerate(tasks):
            of_task = error[(chosen & (task == number)).numpy()]
            cells = ", ".join(f"{target} {np.median(of_task[:, i]):.2f}" for i, target in enumerate(TARGETS))
            print(f"{name}, {sentence}: {cells} cm", flush=True)


if __name__ == "__main__":
    main()
