"""The interface of a world model: subclass `LatentModel` to train, encode and act with your own."""

from abc import ABC, abstractmethod
from dataclasses import dataclass
from typing import Any, Protocol, Self

import torch
from torch import Tensor, nn


class LatentState(Protocol):
    """The state of a model after one frame, (B, ·), or after each of T frames, (B, T, ·)."""

    @property
    def latent(self) -> Tensor:
        """s_t, (B, L) or (B, T, L)."""

    def last(self) -> "LatentState":
        """The state after the last of T frames."""


@dataclass(frozen=True)
class PlainState:
    """A state that consists of its latent alone, (B, L) or (B, T, L)."""

    latent: Tensor

    def last(self) -> Self:
        """The state after the last of T frames, (B, L)."""
        return type(self)(self.latent[:, -1])


class LatentModel(nn.Module, ABC):
    """A model that turns images and actions into latent states.

    A recorded episode is encoded by `embed`, then `filter_embeds`. A running episode is encoded frame by frame by
    `observe`. Both must give the same latents. Images are (B, T, C, H, W) in [0, 1], with several cameras stacked along
    channels. Actions (B, T, A) and proprioception (B, T, P) are in the dataset's units. A model may ignore any of them.
    """

    @property
    def encoding_settings(self) -> dict[str, Any]:
        """Settings that change the latents although the weights stay the same; they are part of the fingerprint."""
        return {}

    @abstractmethod
    def embed(self, images: Tensor, proprio: Tensor | None = None) -> Tensor:
        """Compute the embeddings e_t, each from its own frame alone: (B, T, E)."""

    @abstractmethod
    def filter_embeds(self, embeds: Tensor, actions: Tensor) -> LatentState:
        """Compute the states (B, T, ·) of whole episodes from embeddings and the action a_t executed at each frame.

        s_t may depend on a_{t-1} and earlier actions, never on a_t. A stochastic state is its distribution's mean.
        """

    def filter_frames(self, embeds: Tensor, actions: Tensor) -> PlainState:
        """Compute the states (B, T, ·) of frames, each as the first of an episode; see `filter_embeds`."""
        single = self.filter_embeds(
            embeds.flatten(0, 1)[:, None], torch.zeros_like(actions).flatten(0, 1)[:, None]
        )
        return PlainState(single.latent[:, 0].unflatten(0, embeds.shape[:2]))

    @abstractmethod
    def observe(
        self, images: Tensor, prev_actions: Tensor, state: Any = None, proprio: Tensor | None = None
    ) -> LatentState:
        """Compute the states (B, T, ·) of the next frames from a_{t-1} before each and the state before the first.

        At the start of an episode `state` is None, and the first previous action is a placeholder of zeros.
        """

    def expected_images(self, state: Any) -> Tensor:
        """Predict o_t from everything before it, (B, C, H, W), given the state s_t (B, ·) after it.

        Needed only if the configuration sets `predicts_images`.
        """
        raise NotImplementedError(f"{type(self).__name__} predicts no images.")
