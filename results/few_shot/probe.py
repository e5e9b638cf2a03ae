"""What a world model's encoder says of new tasks: how alive it is, and the error of actions learned from it.

    python results/few_shot/probe.py outputs/few_shot/45_tasks/pretrained_0/checkpoints/last/pretrained_model

A head learns the demonstrated action from z_t of single frames, the task and proprioception, on the first N
demonstrations of each test task. It is tested on the others. Each training image is encoded with 16 random shifts, or
with `--pad=0` once as it is.
"""

import argparse
from pathlib import Path

import torch
from few_shot import MT50, first_of_each
from lerobot.datasets.lerobot_dataset import LeRobotDataset
from torch import Tensor, nn

from lerobot_wm.constants import ML45_TEST, OBS_STATE
from lerobot_wm.encode.episodes import Episode, read_episodes
from lerobot_wm.nn.images import random_crop
from lerobot_wm.nn.mlp import MLP
from lerobot_wm.policies.latent.policy import load_encoder

SHIFTS, STEPS, BATCH = 16, 4000, 256
DEMONSTRATIONS = 25  # of each task, learned from or tested on


@torch.no_grad()
def silent_shares(encoder: nn.Sequential, images: Tensor) -> list[float]:
    """The share of exact zeros after each activation, given scaled images (N, C, S, S)."""
    shares, hidden = [], images
    for layer in encoder:
        hidden = layer(hidden)
        if not isinstance(layer, nn.Conv2d):
            shares.append((hidden == 0).float().mean().item())
    return shares


def main() -> None:
    """Print both for one world model."""
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("world_model")
    parser.add_argument("--dataset", type=Path, default=Path("outputs/mt50_hand/dataset"))
    parser.add_argument(
        "--demonstrations", type=int, default=5, help="of each task that the head learns from"
    )
    parser.add_argument("--pad", type=int, default=4, help="largest shift of a training image, in pixels")
    parser.add_argument("--dropout", type=float, default=0.5)
    parser.add_argument("--seed", type=int, default=0)
    arguments = parser.parse_args()
    torch.manual_seed(arguments.seed)

    policy = load_encoder(arguments.world_model)
    model = policy.world_model.eval()
    chosen = first_of_each(ML45_TEST, DEMONSTRATIONS)
    data = LeRobotDataset("local/mt50_hand_dataset", root=arguments.dataset, episodes=chosen)
    episodes = read_episodes(data, policy.config.cameras, policy.config.image_size, columns=[OBS_STATE])
    tasks = list(dict.fromkeys(episode.task for episode in episodes))
    position = [episode.index % MT50.episodes_per_task for episode in episodes]
    few = [each for each, i in zip(episodes, position, strict=True) if i < arguments.demonstrations]
    others = [each for each, i in zip(episodes, position, strict=True) if i >= arguments.demonstrations]

    @torch.no_grad()
    def latents(of: list[Episode], pad: int = 0) -> Tensor:
        """z_t of every frame as the first of an episode, (N, S)."""
        encoded = []
        for episode in of:
            images = episode.images()  # (T, K·C, S, S)
            with torch.autocast("cpu", torch.bfloat16):
                embeds = model.embed((random_crop(images, pad) if pad else images)[:, None])  # (T, 1, E)
            state = model.filter_embeds(embeds.float(), episode.actions[:, None])
            encoded.append(state.stoch[:, 0])
        return torch.cat(encoded)

    def others_of(of: list[Episode]) -> tuple[Tensor, Tensor, Tensor]:
        """Proprioception (N, P), task ids (N,) and actions (N, A)."""
        ids = torch.cat([torch.full((len(each),), tasks.index(each.task)) for each in of])
        return (
            torch.cat([each.columns[OBS_STATE] for each in of]),
            ids,
            torch.cat([each.actions for each in of]),
        )

    state, task, action = others_of(few)
    mean, std = state.mean(0), state.std(0)

    def observation(z: Tensor, state: Tensor, task: Tensor) -> Tensor:
        return torch.cat([z, nn.functional.one_hot(task, len(tasks)), (state - mean) / std], dim=1)

    images = torch.cat([each.images(slice(None, None, 10)) for each in few])  # (N, K·C, S, S)
    scaled = model.image_scaling(images.movedim(-3, -1)).movedim(-1, -3)
    zeros = silent_shares(model.encoder.layers, scaled)
    print("zeros after each activation:", *(f"{share:.0%}" for share in zeros))

    shifted = torch.stack(
        [latents(few, arguments.pad) for _ in range(SHIFTS if arguments.pad else 1)]
    )  # (K, N, S)
    head = MLP(
        shifted.shape[2] + len(tasks) + state.shape[1],
        [256, 256],
        action.shape[1],
        nn.ReLU,
        arguments.dropout,
    )
    optimizer = torch.optim.Adam(head.parameters(), lr=3e-4)
    decay = torch.optim.lr_scheduler.LambdaLR(optimizer, lambda step: min(1.0, 2 * (1 - step / STEPS)))
    for _ in range(STEPS):
        rows, copy = torch.randint(len(state), (BATCH,)), torch.randint(len(shifted), (BATCH,))
        error = head(observation(shifted[copy, rows], state[rows], task[rows])) - action[rows]
        optimizer.zero_grad()
        error.square().mean().backward()
        optimizer.step()
        decay.step()
    head.eval()
    state, task, action = others_of(others)
    with torch.no_grad():
        error = (head(observation(latents(others), state, task)) - action).square().mean(1)  # (N,)
    for i, name in enumerate(tasks):
        print(f"{error[task == i].mean():.4f} {name}")
    print(f"{error.mean():.4f} mean squared error of actions in other episodes")


if __name__ == "__main__":
    main()
