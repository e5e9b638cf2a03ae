"""The world model: image encoder, RSSM, image decoder and reward head (paper section 3.1.1)."""

import math
from typing import Any

import torch
from torch import Tensor, nn

from lerobot_wm.nn.conv import EMBED_DIM, ConvDecoder, ConvEncoder
from lerobot_wm.nn.images import random_crop
from lerobot_wm.nn.mlp import MLP
from lerobot_wm.nn.normalize import Affine
from lerobot_wm.world_model.config import RSSMConfig
from lerobot_wm.world_model.interface import LatentModel
from lerobot_wm.world_model.losses import reconstruction_loss, world_model_loss
from lerobot_wm.world_model.rssm import RSSM, DiagonalNormal, RSSMState


class WorldModel(LatentModel):
    """An RSSM on images and actions only: no task id, and no proprioception unless `config.use_proprio`.

    Time: frame t holds the image o_t, the action a_t executed there and the reward r_t that arrives with
    o_{t+1}. The filter reads (s_{t-1}, a_{t-1}, o_t); a_{-1}, which nobody took, is the middle of the actions' range
    (`config.centred_start`). The reward head predicts r_{t-1} from s_t.

    Actions, proprioception and images enter in the dataset's own units; `action_scaling`, `proprio_scaling` and
    `image_scaling` hold the statistics that normalise them, so that a checkpoint needs nothing beside itself.
    """

    def __init__(self, config: RSSMConfig) -> None:
        super().__init__()
        self.config = config
        self.encoder = ConvEncoder(config.image_channels)
        self.rssm = RSSM(config, EMBED_DIM)
        self.decoder = ConvDecoder(config.latent_dim, config.image_channels)
        self.action_scaling = Affine(config.action_dim)
        if config.standardize_images:
            self.image_scaling = Affine(config.image_channels)
        if config.predict_reward:
            self.reward_head = MLP(config.latent_dim, [config.reward_hidden_dim] * 2, 1)
        if config.action_scale > 0:
            self.action_head = MLP(config.latent_dim, [config.hidden_dim] * 2, config.action_dim)
        if config.use_proprio:
            self.proprio_scaling = Affine(config.proprio_dim)
            self.proprio_fusion = MLP(EMBED_DIM + config.proprio_dim, [EMBED_DIM], EMBED_DIM)
            self.proprio_decoder = MLP(config.latent_dim, [config.hidden_dim] * 2, config.proprio_dim)

    @property
    def encoding_settings(self) -> dict[str, Any]:
        """Whether the filter is told the actions."""
        return {"hidden_actions": True} if self.config.action_dropout > 0 else {}

    def embed(self, images: Tensor, proprio: Tensor | None = None) -> Tensor:
        """Image embeddings e_t.

        Args:
            images: (B, T, C, 64, 64) in [0, 1].
            proprio: (B, T, P), read only with `config.use_proprio`.

        Returns:
            (B, T, 1024).
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
        """Filter (B, T) frames given the action before each: the streaming form, resumed from `state`.

        Args:
            images: o_t, (B, T, C, 64, 64) in [0, 1].
            prev_actions: a_{t-1}, (B, T, A) in the dataset's units; the first is not read where an episode starts.
            state: s before the first frame, (B, ·); None starts an episode.
            proprio: (B, T, P), with `config.use_proprio`.

        Returns:
            s_t for every frame, (B, T, ·); z_t is the posterior mean.
        """
        embeds = self.embed(images, proprio)
        return self._observe(embeds, self.action_scaling(prev_actions), state)[0]

    def filter(self, images: Tensor, actions: Tensor, proprio: Tensor | None = None) -> RSSMState:
        """Filter whole episodes: as `observe`, given the action executed *at* each frame.

        Args:
            images: o_t, (B, T, C, 64, 64) in [0, 1], from an episode's first frame on.
            actions: a_t, (B, T, A); the last is not used.
            proprio: (B, T, P), with `config.use_proprio`.

        Returns:
            s_t for every frame, (B, T, ·); z_t is the posterior mean.
        """
        return self.filter_embeds(self.embed(images, proprio), actions)

    def filter_embeds(self, embeds: Tensor, actions: Tensor, *, sample: bool = False) -> RSSMState:
        """`filter` for images that are embedded already: embeds (B, T, 1024), actions a_t (B, T, A).

        With `sample` z_t is drawn.
        """
        return self._observe(embeds, self._shift(actions), sample=sample)[0]

    def filter_with_kl(self, embeds: Tensor, actions: Tensor) -> tuple[RSSMState, Tensor]:
        """`filter_embeds`, and how far each image moved the belief: KL(posterior || prior) in nats, (B, T)."""
        states, posterior = self._observe(embeds, self._shift(actions))
        return states, posterior.kl(self.rssm.prior(states.deter))

    def imagine(self, state: RSSMState, actions: Tensor) -> RSSMState:
        """Predict s_{t+1} ... s_{t+H}, z at the prior's mean, from s_t (B, ·) under a_t ... a_{t+H-1}, (B, H, A)."""
        return self.rssm.imagine(state, self.action_scaling(actions))

    def decode(self, latents: Tensor) -> Tensor:
        """Images (..., C, 64, 64), clipped to [0, 1], from latents (..., D+S)."""
        return self._decode(latents).clamp(0, 1)

    def expected_images(self, state: RSSMState) -> Tensor:
        """What o_t was expected to be before it was seen: (B, C, 64, 64) for the s_t (B, ·) it led to.

        From s_{t-1} and a_{t-1} alone; with `action_dropout` above 0 the filter is not told a_{t-1} either.
        """
        # d_t does not depend on o_t; z_t as expected without it is the prior's.
        return self.decode(RSSMState(state.deter, self.rssm.prior(state.deter).mean).latent)

    def predict_reward(self, latents: Tensor) -> Tensor:
        """The reward r_{t-1} that arrived with frame t, (...), from latents s_t (..., D+S)."""
        return self.reward_head(latents).squeeze(-1)

    def loss(
        self,
        images: Tensor,
        actions: Tensor,
        valid: Tensor,
        rewards: Tensor | None = None,
        proprio: Tensor | None = None,
    ) -> tuple[Tensor, dict[str, Tensor]]:
        """The training loss on windows: reconstruction, reward, action, and KL with free nats.

        A window starts from the zero state and, for the previous action, the middle of their range (zeros
        without `config.centred_start`), wherever in its episode it lies. The reward
        loss is averaged over all T frames, though the first has none: it weighs (T-1)/T of `reward_scale`.

        Args:
            images: (B, T, C, 64, 64) in [0, 1].
            actions: a_t, (B, T, A).
            valid: (B, T) bool, False where a window runs past the end of its episode.
            rewards: r_t, (B, T); needed with `config.predict_reward`.
            proprio: (B, T, P); needed with `config.use_proprio`.

        Returns:
            The scalar loss and its parts by name, each a detached scalar.
        """
        embeds = self.embed(self._jitter(images), proprio)
        states, posterior = self._observe(embeds, self._shift(actions), sample=True)
        prior = self.rssm.prior(states.deter)
        latents = states.latent  # (B, T, D+S)
        # Before the action head observes again: compiled for a GPU, that may write where the posterior lies.
        kl = posterior.kl(prior)  # (B, T)

        errors = {"image_loss": self._image_loss(latents, images)}
        if self.config.use_proprio:
            errors["proprio_loss"] = reconstruction_loss(
                self.proprio_decoder(latents), self.proprio_scaling(proprio)
            )
        if self.config.action_scale > 0:
            errors["action_loss"] = self._action_loss(embeds, latents, self.action_scaling(actions))
        if rewards is not None and self.config.predict_reward:
            # s_t predicts r_{t-1}: the first frame of a window has no reward to predict.
            reward_error = (self.predict_reward(latents[:, 1:]) - rewards[:, :-1].float()).square()
            errors["reward_loss"] = nn.functional.pad(reward_error, (1, 0))
        return world_model_loss(errors, kl, valid, self.config)

    def _decode(self, latents: Tensor) -> Tensor:
        """Images (..., C, 64, 64) in float32, not clipped, from latents (..., D+S)."""
        images = self.decoder(latents.flatten(0, -2)).float()
        if self.config.standardize_images:
            images = self.image_scaling.inverse(images.movedim(-3, -1)).movedim(-1, -3)
        return images.unflatten(0, latents.shape[:-1])

    def _image_loss(self, latents: Tensor, images: Tensor) -> Tensor:
        """Error of images (B, T, C, 64, 64) decoded from s_t, (B, T).

        In training with `decode_share` below 1 that of a few frames of each window, weighted so that its mean over
        many draws is the mean of them all; the others' is 0.
        """
        windows, length = latents.shape[:2]
        weight = self.config.image_error_weight
        few = math.ceil(self.config.decode_share * length)
        if few == length or not self.training:
            return reconstruction_loss(self._decode(latents), images, weight)
        window = torch.arange(windows, device=images.device)[:, None]
        frame = torch.rand(windows, length, device=images.device).argsort(1)[:, :few]  # (B, few)
        decoded = self._decode(latents[window, frame])
        error = reconstruction_loss(decoded, images[window, frame], weight)  # (B, few)
        return error.new_zeros(windows, length).scatter(1, frame, error * length / few)

    def _action_loss(self, embeds: Tensor, latents: Tensor, actions: Tensor) -> Tensor:
        """Error of scaled actions a_t (B, T, A) read from s_t, and from what s_t is of o_t alone: (B, T).

        A demonstrator's next action is much like the last one, which memory tells; one frame alone has to be looked at.
        """
        frames = embeds.flatten(0, 1).unsqueeze(1)  # (B * T, 1, E): each the first of an episode
        unknown = frames.new_zeros(len(frames), 1, self.config.action_dim)
        alone = self.rssm.observe(frames, unknown, self.rssm.initial_state(len(frames)), sample=True)[0]
        from_memory, from_frame = (
            reconstruction_loss(self.action_head(each), actions)
            for each in (latents, alone.latent.view_as(latents))
        )
        return 0.5 * (from_memory + from_frame)

    def _jitter(self, images: Tensor) -> Tensor:
        """Images (B, T, C, 64, 64), in training each frame shifted by up to `image_shift` pixels."""
        if self.config.image_shift == 0 or not self.training:
            return images
        return random_crop(images.flatten(0, 1), self.config.image_shift).unflatten(0, images.shape[:2])

    def _observe(
        self, embeds: Tensor, prev_actions: Tensor, state: RSSMState | None = None, *, sample: bool = False
    ) -> tuple[RSSMState, DiagonalNormal]:
        """The RSSM's `observe`, from scaled actions a_{t-1} (B, T, A) as far as it is told them; None starts anew."""
        if state is None:
            state = self.rssm.initial_state(embeds.shape[0])
            if self.config.centred_start:
                prev_actions = nn.functional.pad(prev_actions[:, 1:], (0, 0, 1, 0))
        return self.rssm.observe(embeds, self._told(prev_actions), state, sample=sample)

    def _told(self, prev_actions: Tensor) -> Tensor:
        """What the recurrence is told of scaled actions a_{t-1} (B, T, A): zeros where they are hidden."""
        share = self.config.action_dropout
        if share == 0:
            return prev_actions
        if not self.training:
            return torch.zeros_like(prev_actions)
        told = torch.rand(len(prev_actions), 1, 1, device=prev_actions.device) >= share  # (B, 1, 1)
        return prev_actions * told

    def _shift(self, actions: Tensor) -> Tensor:
        """a_t (B, T, A) -> scaled a_{t-1}, with a zero action (in the dataset's units) before the first frame."""
        return self.action_scaling(nn.functional.pad(actions[:, :-1], (0, 0, 1, 0)))
