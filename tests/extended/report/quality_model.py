"""A world model whose images depend on what it saw and did, as a trained one's do."""

from pathlib import Path

import torch

from lerobot_wm.inspect.episodes import load_world_model
from lerobot_wm.world_model.model import WorldModel


@torch.no_grad()
def lively_world_model(path: Path) -> WorldModel:
    """The checkpoint's world model with weights scaled up: fresh ones decode every state to nearly one image."""
    world_model = load_world_model(str(path)).world_model
    assert isinstance(world_model, WorldModel)
    for weight, scale in (
        (world_model.encoder.layers[-2].weight, 20),
        (world_model.rssm.recurrent_input.weight, 3),
        (world_model.rssm.posterior_params.weight, 5),
        (world_model.decoder.input.weight, 100),
    ):
        weight.mul_(scale)
    deter_dim = world_model.config.deter_dim
    world_model.rssm.gru.bias_ih[deter_dim : 2 * deter_dim] += (
        4  # the update gate: remember for dozens of steps
    )
    return world_model
