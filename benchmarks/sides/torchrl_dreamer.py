"""Training steps of TorchRL's Dreamer: its modules, loss and rollout with our weights and batch.

One layer is changed: the activation after the decoder's first linear layer is removed. Neither Dreamer V1 nor our model
has it.
"""

from pathlib import Path
from unittest.mock import patch

import torch
import torchrl
from tensordict import TensorDict
from tensordict.nn import TensorDictModule, TensorDictSequential
from torch import Tensor, nn
from torchrl.data import Bounded
from torchrl.modules import MLP, ObsDecoder, ObsEncoder, RSSMPosterior, RSSMPrior, RSSMRollout
from torchrl.modules.tensordict_module.world_models import WorldModelWrapper
from torchrl.objectives import DreamerModelLoss

from benchmarks.sides.shared import batch_file, half_noise
from benchmarks.timing import Prepared, timed_updates

STATE, HIDDEN, EMBED, ACTION = 256, 256, 1024, 4
LEARNING_RATE, CLIP = 6e-4, 100.0


def prepare(folder: Path, batch: int, length: int, seconds: float) -> Prepared:
    """Time training steps, and report the loss, its parts and its gradient norm before the first step.

    Args:
        folder: Folder where our side saved its weights and batch.
        batch: B.
        length: T.
        seconds: Duration of one measurement.
    """
    saved = torch.load(batch_file(folder, batch, length), weights_only=True)
    world_model = _world_model()
    _load(world_model, saved["weights"])
    loss_module = DreamerModelLoss(world_model)
    # Ours filters o_t with a_{t-1}, and predicts r_{t-1} at frame t. In TorchRL these are transitions from t-1 to t.
    prev_actions = nn.functional.pad(saved["actions"][:, :-1], (0, 0, 1, 0))  # (B, T, A)
    rewards = nn.functional.pad(saved["rewards"][:, :-1], (1, 0)).unsqueeze(-1)  # (B, T, 1)

    def data() -> TensorDict:
        pixels = (saved["frames"].float() / 255).movedim(-1, -3)  # (B, T, C, H, W)
        return TensorDict(
            {
                "state": torch.zeros(batch, length, STATE),
                "belief": torch.zeros(batch, length, HIDDEN),
                "action": prev_actions,
                "next": TensorDict({"pixels": pixels, "reward": rewards}, [batch, length]),
            },
            [batch, length],
        )

    def loss() -> tuple[Tensor, TensorDict]:
        losses, states = loss_module(data())
        return sum(losses.values()).squeeze(), states

    with patch("torch.randn_like", half_noise):
        # Our loss has no reward target at a window's first frame. Use the prediction as the target there: error zero.
        with torch.no_grad():
            rewards[:, 0] = loss()[1]["next", "reward"][:, 0]
        facts = _losses(loss_module, data())
    optimizer = torch.optim.Adam(world_model.parameters(), lr=LEARNING_RATE)

    def step() -> None:
        value, _ = loss()
        value.backward()
        nn.utils.clip_grad_norm_(world_model.parameters(), CLIP)
        optimizer.step()
        optimizer.zero_grad()

    return timed_updates(step, seconds, {**facts, "dtype": "float32", "torchrl": torchrl.__version__})


def _losses(loss_module: DreamerModelLoss, data: TensorDict) -> dict[str, float]:
    """Return the loss, its parts and its gradient norm under our names; `kl` without the free nats."""
    total = sum(loss_module(data)[0].values())
    total.backward()
    norm = nn.utils.get_total_norm(p.grad for p in loss_module.parameters())
    loss_module.zero_grad()
    free_nats, loss_module.free_nats = loss_module.free_nats, 0
    with torch.no_grad():
        parts, _ = loss_module(data)
    loss_module.free_nats = free_nats
    names = {"image_loss": "loss_model_reco", "reward_loss": "loss_model_reward", "kl": "loss_model_kl"}
    values = {ours: parts[theirs].item() for ours, theirs in names.items()}
    return {"loss": total.item(), **values, "gradient_norm": norm.item()}


def _world_model() -> WorldModelWrapper:
    """Compose the world model like TorchRL's Dreamer example, with the sizes of our model."""
    decoder = ObsDecoder(latent_dim=STATE + HIDDEN)
    decoder.state_to_latent[1] = nn.Identity()
    prior = RSSMPrior(Bounded(-1, 1, (ACTION,)), HIDDEN, HIDDEN, STATE, action_dim=ACTION)
    posterior = RSSMPosterior(HIDDEN, STATE, rnn_hidden_dim=HIDDEN, obs_embed_dim=EMBED)
    rollout = RSSMRollout(
        TensorDictModule(
            prior,
            in_keys=["state", "belief", "action"],
            out_keys=[("next", "prior_mean"), ("next", "prior_std"), "_", ("next", "belief")],
        ),
        TensorDictModule(
            posterior,
            in_keys=[("next", "belief"), ("next", "encoded_latents")],
            out_keys=[("next", "posterior_mean"), ("next", "posterior_std"), ("next", "state")],
        ),
    )
    states = [("next", "state"), ("next", "belief")]
    transition = TensorDictSequential(
        TensorDictModule(
            ObsEncoder(in_channels=3), in_keys=[("next", "pixels")], out_keys=[("next", "encoded_latents")]
        ),
        rollout,
        TensorDictModule(decoder, in_keys=states, out_keys=[("next", "reco_pixels")]),
    )
    reward = MLP(STATE + HIDDEN, 1, depth=2, num_cells=400, activation_class=nn.ELU)
    return WorldModelWrapper(
        transition, TensorDictModule(reward, in_keys=states, out_keys=[("next", "reward")])
    )


def _load(world_model: WorldModelWrapper, weights: dict[str, Tensor]) -> None:
    """Copy our weights; within each part, the parameters of both models have the same order.

    Raises:
        RuntimeError: The shapes of two parameters differ.
    """
    encoder, rollout, decoder = (world_model[0][i] for i in range(3))
    prior, posterior = rollout.rssm_prior.module, rollout.rssm_posterior.module
    parts: list[tuple[nn.Module, list[str]]] = [
        (encoder, ["encoder."]),
        (prior.action_state_projector, ["rssm.recurrent_input."]),
        (prior.rnn, ["rssm.gru."]),
        (prior.rnn_to_prior_projector, ["rssm.prior_hidden.", "rssm.prior_params."]),
        (posterior, ["rssm.posterior_hidden.", "rssm.posterior_params."]),
        (decoder, ["decoder."]),
        (world_model[1], ["reward_head."]),
    ]
    for module, prefixes in parts:
        names = [name for prefix in prefixes for name in weights if name.startswith(prefix)]
        for parameter, name in zip(module.parameters(), names, strict=True):
            value = weights[name]
            if name in ("decoder.input.weight", "reward_head.trunk.0.weight"):
                value = value.roll(STATE, dims=1)  # theirs reads [z, d], ours [d, z]
            if parameter.shape != value.shape:
                raise RuntimeError(
                    f"{name}: our shape is {tuple(value.shape)}, TorchRL's {tuple(parameter.shape)}."
                )
            parameter.data.copy_(value)
