"""The world model: image encoder, RSSM, image decoder and reward head (paper section 3.1.1)."""

import math
from typing import Any

import torch
from torch import Tensor, nn

from lerobot_wm.nn.conv import make_decoder, make_encoder
from lerobot_wm.nn.images import random_crop
from lerobot_wm.nn.mlp import MLP
from lerobot_wm.nn.normalize import Affine
from lerobot_wm.world_model.config import RSSMConfig
from lerobot_wm.world_model.interface import LatentModel
from lerobot_wm.world_model.rssm import RSSM, DiagonalNormal, RSSMState


class WorldModel(LatentModel):
    """An RSSM on images and actions: no task id, and no proprioception unless `config.use_proprio`.

    Time: frame t holds the image o_t, the action a_t executed there and the reward r_t that arrives with o_{t+1}. The
    filter reads (s_{t-1}, a_{t-1}, o_t). Before the first frame of an episode, a_{-1} is the middle of the actions'
    range. The reward head predicts r_{t-1} from s_t.

    Actions, proprioception and images enter in the dataset's units. `action_scaling`, `proprio_scaling` and
    `image_scaling` hold the statistics that normalize them, so a checkpoint is complete by itself.
    """

    def __init__(self, config: RSSMConfig) -> None:
        super().__init__()
        self.config = config
        image = config.image_channels, config.image_size, config.n_keypoints
        self.encoder = make_encoder(*image, config.encoder_activation)
        embed_dim = self.encoder.embed_dim
        self.rssm = RSSM(config, embed_dim)
        self.decoder = make_decoder(config.latent_dim, *image)
        self.action_scaling = Affine(config.action_dim)
        if config.standardize_images:
            self.image_scaling = Affine(config.image_channels)
        if config.predict_reward:
            self.reward_head = MLP(config.latent_dim, [config.reward_hidden_dim] * 2, 1)
        if config.action_scale > 0:
            n_predicted = config.action_horizon * config.action_dim
            self.action_head = MLP(config.latent_dim, [config.hidden_dim] * 2, n_predicted)
        if config.use_proprio:
            self.proprio_scaling = Affine(config.proprio_dim)
            self.proprio_fusion = MLP(embed_dim + config.proprio_dim, [embed_dim], embed_dim)
            self.proprio_decoder = MLP(config.latent_dim, [config.hidden_dim] * 2, config.proprio_dim)

    @property
    def encoding_settings(self) -> dict[str, Any]:
        """Whether the filter is given the actions, and an activation other than the paper's."""
        settings: dict[str, Any] = {"hidden_actions": True} if self.config.hidden_action_share else {}
        if self.config.encoder_activation != "relu":
            settings["encoder_activation"] = self.config.encoder_activation
        return settings

    def embed(self, images: Tensor, proprio: Tensor | None = None) -> Tensor:
        """Compute the image embeddings e_t.

        Args:
            images: (B, T, C, S, S) in [0, 1].
            proprio: (B, T, P), read only with `config.use_proprio`.

        Returns:
            (B, T, E).
        """
        batch_time = images.shape[:2]
        if self.config.standardize_images:
            images = self.image_scaling(images.movedim(-3, -1)).movedim(-1, -3)
        embeds = self.encoder(images.flatten(0, 1)).unflatten(0, batch_time)
        if self.config.use_proprio:
            embeds = self.proprio_fusion(torch.cat([embeds, self.proprio_scaling(proprio)], dim=-1))
        return embeds

    def observe(
        self,
        images: Tensor,
        prev_actions: Tensor,
        state: RSSMState | None = None,
        proprio: Tensor | None = None,
    ) -> RSSMState:
        """Filter the next frames of a running episode, given the action before each.

        Args:
            images: o_t, (B, T, C, S, S) in [0, 1].
            prev_actions: a_{t-1}, (B, T, A) in the dataset's units. At the start of an episode the first is ignored.
            state: s before the first frame, (B, ·); None starts an episode.
            proprio: (B, T, P), with `config.use_proprio`.

        Returns:
            s_t for every frame, (B, T, ·); z_t is the posterior mean.
        """
        embeds = self.embed(images, proprio)
        return self._observe(embeds, self.action_scaling(prev_actions), state)[0]

    def filter(self, images: Tensor, actions: Tensor, proprio: Tensor | None = None) -> RSSMState:
        """Filter whole episodes, given the action executed *at* each frame.

        Args:
            images: o_t, (B, T, C, S, S) in [0, 1], from an episode's first frame on.
            actions: a_t, (B, T, A) in the dataset's units. The last one is ignored.
            proprio: (B, T, P), with `config.use_proprio`.

        Returns:
            s_t for every frame, (B, T, ·); z_t is the posterior mean.
        """
        return self.filter_embeds(self.embed(images, proprio), actions)

    def filter_embeds(self, embeds: Tensor, actions: Tensor) -> RSSMState:
        """Filter whole episodes from embeddings (B, T, E) and actions a_t (B, T, A); z_t is the posterior mean."""
        return self._observe(embeds, self._previous_actions(actions))[0]

    def filter_with_kl(self, embeds: Tensor, actions: Tensor) -> tuple[RSSMState, Tensor]:
        """Filter as `filter_embeds` does; also return KL(posterior || prior) in nats, (B, T)."""
        states, posterior = self._observe(embeds, self._previous_actions(actions))
        return states, posterior.kl(self.rssm.prior(states.deter))

    def imagine(self, state: RSSMState, actions: Tensor) -> RSSMState:
        """Predict s_{t+1} ... s_{t+H} from s_t (B, ·) and a_t ... a_{t+H-1} (B, H, A); z is the prior's mean."""
        return self.rssm.imagine(state, self.action_scaling(actions))

    def decode(self, latents: Tensor) -> Tensor:
        """Decode latents (..., D+S) to images (..., C, S, S), clipped to [0, 1]."""
        return self._decode(latents).clamp(0, 1)

    def expected_images(self, state: RSSMState) -> Tensor:
        """Predict o_t (B, C, S, S) from s_{t-1} and a_{t-1}, given the state s_t (B, ·) after it.

        With `hidden_action_share` above 0 the prediction does not know a_{t-1}.
        """
        # d_t does not depend on o_t, and the prior predicts z_t without it.
        return self.decode(RSSMState(state.deter, self.rssm.prior(state.deter).mean).latent)

    def predict_reward(self, latents: Tensor) -> Tensor:
        """Predict the reward r_{t-1} that arrived with frame t, (...), from latents s_t (..., D+S)."""
        return self.reward_head(latents).squeeze(-1)

    def loss(
        self,
        images: Tensor,
        actions: Tensor,
        valid: Tensor,
        rewards: Tensor | None = None,
        proprio: Tensor | None = None,
    ) -> tuple[Tensor, dict[str, Tensor]]:
        """Compute the training loss on windows: reconstruction, reward, action, and KL with free nats.

        A window starts from the zero state, wherever it lies in its episode. The reward loss is averaged over all T
        frames although the first has none, so its weight is (T-1)/T of `reward_scale`.

        Args:
            images: (B, T, C, S, S) in [0, 1].
            actions: a_t, (B, T+K-1, A) in the dataset's units: those of the window, and with an `action_horizon` of K
                K-1 more for the action loss.
            valid: (B, T+K-1) bool, False where a window runs past the end of its episode.
            rewards: r_t, (B, T); needed with `config.predict_reward`.
            proprio: (B, T, P); needed with `config.use_proprio`.

        Returns:
            The scalar loss, and its parts by name as detached scalars.
        """
        embeds = self.embed(self._shift_images(images), proprio)
        length = images.shape[1]
        states, posterior = self._observe(embeds, self._previous_actions(actions[:, :length]), sample=True)
        prior = self.rssm.prior(states.deter)
        latents = states.latent  # (B, T, D+S)
        # Computed before the action head filters again: compiled for a GPU, that call may overwrite the posterior.
        kl = posterior.kl(prior)  # (B, T)

        errors = {"image_loss": self._image_loss(latents, images)}
        if self.config.use_proprio:
            errors["proprio_loss"] = reconstruction_loss(
                self.proprio_decoder(latents), self.proprio_scaling(proprio)
            )
        if self.config.action_scale > 0:
            errors["action_loss"] = self._action_loss(embeds, latents, self.action_scaling(actions), valid)
        if rewards is not None and self.config.predict_reward:
            # s_t predicts r_{t-1}: the first frame of a window has no reward to predict.
            reward_error = (self.predict_reward(latents[:, 1:]) - rewards[:, :-1].float()).square()
            errors["reward_loss"] = nn.functional.pad(reward_error, (1, 0))
        return world_model_loss(errors, kl, valid[:, :length], self.config)

    def _decode(self, latents: Tensor) -> Tensor:
        """Decode latents (..., D+S) to images (..., C, S, S) in float32, not clipped."""
        images = self.decoder(latents.flatten(0, -2)).float()
        if self.config.standardize_images:
            images = self.image_scaling.inverse(images.movedim(-3, -1)).movedim(-1, -3)
        return images.unflatten(0, latents.shape[:-1])

    def _image_loss(self, latents: Tensor, images: Tensor) -> Tensor:
        """Compute the error (B, T) of the images (B, T, C, S, S) decoded from latents (B, T, D+S).

        In training with `decode_share` below 1, only some frames of each window are decoded. Their errors are scaled
        up so that the expected mean stays the same; the other frames have an error of 0.
        """
        windows, length = latents.shape[:2]
        few = math.ceil(self.config.decode_share * length)
        if few == length or not self.training:
            return reconstruction_loss(self._decode(latents), images)
        window = torch.arange(windows, device=images.device)[:, None]  # (B, 1)
        frame = torch.rand(windows, length, device=images.device).argsort(1)[:, :few]  # (B, few)
        decoded = self._decode(latents[window, frame])  # (B, few, C, S, S)
        error = reconstruction_loss(decoded, images[window, frame])  # (B, few)
        return error.new_zeros(windows, length).scatter(1, frame, error * length / few)

    def _action_loss(self, embeds: Tensor, latents: Tensor, actions: Tensor, valid: Tensor) -> Tensor:
        """Compute the error (B, T) of scaled actions a_t ... a_{t+K-1}, predicted from s_t and from frame t alone.

        It is their mean, over those of the K in the episode: actions (B, T+K-1, A), valid (B, T+K-1).

        A demonstrator's next action resembles the last one, which the memory holds. A single frame has no memory: to
        predict the action from it, the encoder has to look.
        """
        frames = embeds.flatten(0, 1).unsqueeze(1)  # (B·T, 1, E), each as the first frame of an episode
        unknown = frames.new_zeros(len(frames), 1, self.config.action_dim)
        alone = self.rssm.observe(frames, unknown, self.rssm.initial_state(len(frames)), sample=True)[0]
        targets = actions.unfold(1, self.config.action_horizon, 1).mT  # (B, T, K, A)
        known = valid.unfold(1, self.config.action_horizon, 1).float()  # (B, T, K)
        from_memory, from_frame = (
            (self.action_head(each).float().view_as(targets) - targets).square().sum(-1)  # (B, T, K)
            for each in (latents, alone.latent.view_as(latents))
        )
        return 0.5 * ((from_memory + from_frame) * known).sum(-1) / known.sum(-1).clamp(min=1)

    def _shift_images(self, images: Tensor) -> Tensor:
        """Shift each frame of images (B, T, C, S, S) by up to `image_shift` pixels, in training only."""
        if self.config.image_shift == 0 or not self.training:
            return images
        return random_crop(images.flatten(0, 1), self.config.image_shift).unflatten(0, images.shape[:2])

    def _observe(
        self, embeds: Tensor, prev_actions: Tensor, state: RSSMState | None = None, *, sample: bool = False
    ) -> tuple[RSSMState, DiagonalNormal]:
        """Run the RSSM's filter on scaled actions a_{t-1} (B, T, A); a state of None starts an episode."""
        if state is None:
            state = self.rssm.initial_state(embeds.shape[0])
            # Zero is the middle of the scaled actions' range.
            prev_actions = nn.functional.pad(prev_actions[:, 1:], (0, 0, 1, 0))
        return self.rssm.observe(embeds, self._hide(prev_actions), state, sample=sample)

    def _hide(self, prev_actions: Tensor) -> Tensor:
        """Replace scaled actions a_{t-1} (B, T, A) by zeros where the filter is not given them."""
        share = self.config.hidden_action_share
        if not share:
            return prev_actions
        if not self.training:
            return torch.zeros_like(prev_actions)
        given = torch.rand(len(prev_actions), 1, 1, device=prev_actions.device) >= share  # (B, 1, 1)
        return prev_actions * given

    def _previous_actions(self, actions: Tensor) -> Tensor:
        """Turn a_t (B, T, A) into scaled a_{t-1}; the entry before the first frame is a placeholder."""
        return self.action_scaling(nn.functional.pad(actions[:, :-1], (0, 0, 1, 0)))


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
