"""The variational bound of the paper's section 3.1.1 as plain functions."""

from torch import Tensor

from lerobot_wm.world_model.config import RSSMConfig


def reconstruction_loss(prediction: Tensor, target: Tensor) -> Tensor:
    """Squared error summed over everything but batch and time: (B, T, ...) -> (B, T), in float32."""
    return (prediction.float() - target.float()).square().flatten(2).sum(-1)


def masked_mean(values: Tensor, valid: Tensor) -> Tensor:
    """Mean of the values (B, T) where `valid` (B, T) is true."""
    weight = valid.to(values.dtype)
    return (values * weight).sum() / weight.sum().clamp(min=1)


def world_model_loss(
    errors: dict[str, Tensor], kl: Tensor, valid: Tensor, config: RSSMConfig
) -> tuple[Tensor, dict[str, Tensor]]:
    """Sum of the reconstruction terms and the KL, which is clamped per step at the free nats (as in TorchRL's Dreamer).

    Args:
        errors: Per-step terms, each (B, T): `image_loss`; `reward_loss`, `action_loss`, `proprio_loss` if modelled.
        kl: KL(posterior || prior) in nats, (B, T).
        valid: (B, T) bool, True for the steps that count.
        config: Gives the weights β (`kl_scale`), `reward_scale` and `action_scale`, and `free_nats`.

    Returns:
        The scalar loss, and its parts by name as detached scalars. Among them are the unclamped KL and the share of
        steps below the free nats.
    """
    scales = {
        "image_loss": 1.0,
        "proprio_loss": 1.0,
        "reward_loss": config.reward_scale,
        "action_loss": config.action_scale,
    }
    metrics = {name: masked_mean(error, valid) for name, error in errors.items()}
    kl_loss = masked_mean(kl.clamp(min=config.free_nats), valid)
    loss = sum((scales[name] * value for name, value in metrics.items()), start=config.kl_scale * kl_loss)
    metrics |= {
        "kl_loss": kl_loss,
        "kl": masked_mean(kl, valid),
        "under_free_nats": masked_mean((kl < config.free_nats).float(), valid),
    }
    return loss, {name: value.detach() for name, value in metrics.items()}
