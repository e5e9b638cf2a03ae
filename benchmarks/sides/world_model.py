"""Training steps of our world model: gradients, clipping and Adam on a batch of windows."""

from pathlib import Path
from unittest.mock import patch

import torch
from torch import Tensor

from benchmarks.sides.shared import batch_file, half_noise
from benchmarks.timing import Prepared, timed_updates
from lerobot_wm.constants import ACTION_DIM, IMAGE_SIZE
from lerobot_wm.policies.wm_rssm.configuration_wm_rssm import WMRSSMConfig
from lerobot_wm.world_model.config import RSSMConfig
from lerobot_wm.world_model.model import WorldModel


def prepare(folder: Path, batch: int, length: int, seconds: float) -> Prepared:
    """Time training steps, and report the loss, its parts and its gradient norm before the first step.

    Args:
        folder: Folder to save weights and batch to, for the peer.
        batch: B.
        length: T.
        seconds: Duration of one measurement.
    """
    torch.manual_seed(0)
    config = WMRSSMConfig(device="cpu")
    model = WorldModel(RSSMConfig(image_channels=3, action_dim=ACTION_DIM))
    frames = torch.randint(0, 256, (batch, length, IMAGE_SIZE, IMAGE_SIZE, 3), dtype=torch.uint8)
    actions = torch.rand(batch, length, ACTION_DIM) * 2 - 1  # (B, T, A)
    rewards = (torch.rand(batch, length) < 0.1).float()  # (B, T)
    valid = torch.ones(batch, length, dtype=torch.bool)
    torch.save(
        {"weights": model.state_dict(), "frames": frames, "actions": actions, "rewards": rewards},
        batch_file(folder, batch, length),
    )

    def loss() -> tuple[Tensor, dict[str, Tensor]]:
        images = frames.movedim(-1, -3).float() / 255  # (B, T, C, H, W), as LeRobot's loop receives them
        return model.loss(images, actions, valid, rewards)

    with patch("torch.randn_like", half_noise):
        total, parts = loss()  # in float32; bfloat16 would differ by more than the tolerance
        total.backward()
    # `kl` is the divergence itself, without the free nats that may hide it in the loss.
    facts = {"loss": total.item()} | {
        name: parts[name].item() for name in ("image_loss", "reward_loss", "kl")
    }
    gradients = [parameter.grad for parameter in model.parameters() if parameter.grad is not None]
    facts["gradient_norm"] = torch.nn.utils.get_total_norm(gradients).item()
    model.zero_grad()
    preset = config.get_optimizer_preset()
    optimizer = preset.build(model.parameters())

    def step() -> None:
        with torch.autocast("cpu", dtype=torch.bfloat16, enabled=config.dtype == "bfloat16"):
            value, _ = loss()
        value.backward()
        torch.nn.utils.clip_grad_norm_(model.parameters(), preset.grad_clip_norm)
        optimizer.step()
        optimizer.zero_grad()

    return timed_updates(step, seconds, {**facts, "dtype": str(config.dtype)})
