"""People's PushT: do the latents tell where the block is, where nobody has pushed it yet?

    python results/pusht/corners.py read --world_model=outputs/pusht_wm_small/checkpoints/last/pretrained_model \
        --state_policy=outputs/pusht_state/checkpoints/last/pretrained_model --root=data/pusht_human
    python results/pusht/corners.py learn --root=data/pusht_human --n_keypoints=64

`read` learns the block's corners from the latents s_t of nine tenths of the demonstrations, and prints the error on
the rest; with `--part` from d_t, z_t or the embedding e_t alone. With `--state_policy`, that policy of the full state
acts on the corners that were read from s_t, in the loop.

`learn` trains the world model's encoder on the corners instead, with flattened features or keypoints, and with images
shifted by up to `--shift` pixels and the corners with them.
"""

import argparse
from functools import partial
from typing import Any

import gym_pusht  # noqa: F401  # registers the environment
import gymnasium as gym
import numpy as np
import torch
from lerobot.configs import PreTrainedConfig
from lerobot.datasets.lerobot_dataset import LeRobotDataset
from lerobot.policies.factory import get_policy_class
from torch import Tensor, nn
from torch.nn import functional as F

from lerobot_wm.constants import OBS_ENV_STATE
from lerobot_wm.encode.episodes import Episode, embed_episodes, read_episodes
from lerobot_wm.inspect.episodes import filter_episodes, load_world_model, rssm_of
from lerobot_wm.nn.conv import make_encoder
from lerobot_wm.nn.images import camera_images
from lerobot_wm.nn.mlp import MLP
from lerobot_wm.nn.normalize import Affine
from lerobot_wm.world_model.model import WorldModel

CAMERA = "observation.image"
BOARD, SIZE = 512, 64  # pixels of the board, in which corners are given, and of the images
MAX_STEPS = 300
PARTS = {"frames 0-19": (0, 20), "20-49": (20, 50), "50 on": (50, 10_000)}


def is_held_out(episodes: list[Episode]) -> Tensor:
    """Whether a frame belongs to every tenth episode, (frames,) bool."""
    return torch.cat([torch.full((len(each),), i % 10 == 9) for i, each in enumerate(episodes)])


def fit(model: nn.Module, batch: Any, steps: int) -> None:
    """Train a model on batches (inputs, corners scaled to unit variance) by their absolute error."""
    optimizer = torch.optim.AdamW(model.parameters(), 1e-3, weight_decay=1e-4)
    schedule = torch.optim.lr_scheduler.OneCycleLR(optimizer, 1e-3, steps)
    for _ in range(steps):
        inputs, corners = batch()
        loss = (model(inputs) - corners).abs().mean()
        optimizer.zero_grad()
        loss.backward()
        optimizer.step()
        schedule.step()


def print_errors(predicted: Tensor, episodes: list[Episode]) -> None:
    """Print the median error of predicted corners (frames, 16) in pixels of the board, by time in the episode."""
    error = (predicted - corners_of(episodes)).abs().mean(1)  # (frames,)
    frame = torch.cat([torch.arange(len(each)) for each in episodes])
    held_out = is_held_out(episodes)
    for name, (low, high) in PARTS.items():
        part = (frame >= low) & (frame < high)
        learned, rest = (error[part & chosen].median() for chosen in (~held_out, held_out))
        print(
            f"{name}: {learned:.1f} px on the episodes it learned from, {rest:.1f} px on the others",
            flush=True,
        )


def corners_of(episodes: list[Episode]) -> Tensor:
    """The block's corners, (frames, 16) in pixels of the board."""
    return torch.cat([each.columns[OBS_ENV_STATE] for each in episodes]).float()


def read(arguments: argparse.Namespace, episodes: list[Episode]) -> None:
    """Read the corners from latents, and perhaps act on what was read."""
    policy = load_world_model(arguments.world_model)
    latents = part_of(rssm_of(policy), episodes, arguments.part)  # (frames, L)
    corners, learned = corners_of(episodes), torch.nonzero(~is_held_out(episodes)).flatten()
    inputs, targets = standard_scaling(latents), standard_scaling(corners)
    model = MLP(latents.shape[1], [512, 512], corners.shape[1], nn.ReLU)

    def batch() -> tuple[Tensor, Tensor]:
        chosen = learned[torch.randint(len(learned), (256,))]
        return inputs(latents[chosen]), targets(corners[chosen])

    fit(model, batch, arguments.steps)
    model.eval()

    @torch.inference_mode()
    def corners_at(latent: Tensor) -> Tensor:
        return targets.inverse(model(inputs(latent)))

    print_errors(corners_at(latents), episodes)
    if arguments.state_policy:
        act(policy, load_policy(arguments.state_policy), corners_at, arguments.n_episodes)


@torch.inference_mode()
def part_of(model: WorldModel, episodes: list[Episode], part: str) -> Tensor:
    """s_t, d_t, z_t or e_t of all episodes, (frames, L)."""
    if part == "e":
        return torch.cat([embed_episodes(model, [each])[0][0] for each in episodes])
    latents = torch.cat([each.latents for each in filter_episodes(model, episodes)])
    deter, stoch = latents.split([model.config.deter_dim, model.config.stoch_dim], dim=-1)
    return {"s": latents, "d": deter, "z": stoch}[part]


def standard_scaling(samples: Tensor) -> Affine:
    """To zero mean and unit variance of samples (N, D)."""
    scaling = Affine(samples.shape[1])
    scaling.set_standard(samples.mean(0), samples.std(0))
    return scaling


def load_policy(path: str) -> Any:
    """A policy on the CPU."""
    config = PreTrainedConfig.from_pretrained(path)
    config.device = "cpu"
    return get_policy_class(config.type).from_pretrained(path, config=config)


@torch.inference_mode()
def act(world_model: Any, policy: Any, corners_at: Any, n_episodes: int) -> None:
    """Roll out a policy of the full state on corners that are read from latents, from the starts of `--seed=2000`."""
    make = partial(gym.make, "gym_pusht/PushT-v0", obs_type="pixels_agent_pos")
    envs: list[Any] = [make().unwrapped for _ in range(n_episodes)]
    observations = [env.reset(seed=2000 + i)[0] for i, env in enumerate(envs)]
    best, is_done, errors = np.zeros(n_episodes), np.zeros(n_episodes, dtype=bool), []
    model, state, previous = rssm_of(world_model), None, torch.zeros(n_episodes, 2)
    for _ in range(MAX_STEPS):
        pixels = torch.from_numpy(np.stack([each["pixels"] for each in observations]))  # (N, 96, 96, 3)
        batch = {CAMERA: pixels.permute(0, 3, 1, 2) / 255}
        images = camera_images(batch, [CAMERA], world_model.config.image_size)  # (N, 3, 64, 64)
        states = model.observe(images[:, None], previous[:, None], state)
        state = states.last()
        corners = corners_at(state.latent)  # (N, 16)
        true = np.stack([env.get_keypoints(env.block.shapes).flatten() for env in envs])  # (N, 16)
        errors.append(np.abs(corners.numpy() - true).mean(1)[~is_done])
        position = torch.from_numpy(np.stack([each["agent_pos"] for each in observations])).float()  # (N, 2)
        previous = policy.select_action({"observation.state": position, OBS_ENV_STATE: corners})
        for i in np.flatnonzero(~is_done):
            observations[i], reward, terminated, *_ = envs[i].step(previous[i].numpy())
            best[i], is_done[i] = max(best[i], reward), terminated
        if is_done.all():
            break
    print(
        f"in the loop: {np.median(np.concatenate(errors)):.1f} px; best coverage {best.mean():.2f}; "
        f"{is_done.sum()} of {n_episodes} solved"
    )


def learn(arguments: argparse.Namespace, episodes: list[Episode]) -> None:
    """Train the world model's encoder on the corners."""
    images = torch.cat([each.images() for each in episodes])  # (frames, 3, 64, 64) in [0, 1]
    corners, learned = corners_of(episodes), torch.nonzero(~is_held_out(episodes)).flatten()
    encoder = make_encoder(3, SIZE, arguments.n_keypoints)
    model = nn.Sequential(encoder, MLP(encoder.embed_dim, [256, 256], corners.shape[1], nn.ReLU))
    targets, shift = standard_scaling(corners), arguments.shift

    def batch() -> tuple[Tensor, Tensor]:
        chosen = learned[torch.randint(len(learned), (64,))]
        offsets = torch.randint(-shift, shift + 1, (64, 2))  # to the right and down
        padded = F.pad(images[chosen], (shift,) * 4, mode="replicate")
        shifted = [
            image[:, shift - y : shift - y + SIZE, shift - x : shift - x + SIZE]
            for image, (x, y) in zip(padded, offsets.tolist(), strict=True)
        ]
        moved = corners[chosen] + BOARD / SIZE * offsets.repeat(1, corners.shape[1] // 2)
        return torch.stack(shifted) - 0.5, targets(moved)

    fit(model, batch, arguments.steps)
    with torch.inference_mode():
        print_errors(targets.inverse(torch.cat([model(each - 0.5) for each in images.split(256)])), episodes)


def main() -> None:
    """Read the arguments and run what they ask for."""
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    commands = parser.add_subparsers(required=True)
    reading = commands.add_parser("read")
    reading.add_argument("--world_model", required=True)
    reading.add_argument("--part", choices="sdze", default="s")
    reading.add_argument("--state_policy")
    reading.add_argument("--n_episodes", type=int, default=50)
    reading.set_defaults(run=read)
    learning = commands.add_parser("learn")
    learning.add_argument("--n_keypoints", type=int, default=0)
    learning.add_argument("--shift", type=int, default=0)
    learning.set_defaults(run=learn)
    for each in (reading, learning):
        each.add_argument("--root", required=True)
        each.add_argument("--steps", type=int, default=6000)
    arguments = parser.parse_args()
    torch.set_num_threads(1)
    torch.manual_seed(0)
    dataset = LeRobotDataset("demonstrations/pusht", arguments.root)
    arguments.run(arguments, read_episodes(dataset, [CAMERA], (SIZE, SIZE), columns=[OBS_ENV_STATE]))


if __name__ == "__main__":
    main()
