"""What a world model has to offer to be trained as one, encode datasets and be acted on: subclass `LatentModel`."""

from abc import ABC, abstractmethod
from dataclasses import dataclass
from typing import Any, Protocol, Self

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
    """A state that is its latent and nothing else, (B, L) or (B, T, L)."""

    latent: Tensor

    def last(self) -> Self:
        """The state after the last of T frames, (B, L)."""
        return type(self)(self.latent[:, -1])


class LatentModel(nn.Module, ABC):
    """A world model, or what stands in its place: images and actions in, latent states out.

    Whole episodes are encoded by `embed` and then `filter_embeds`, a running episode frame by frame by `observe`: the
    latents must be the same. Images are (B, T, C, H, W) in [0, 1], several cameras stacked along channels; actions
    (B, T, A) and proprioception (B, T, P) are in the dataset's units. A model ignores what it does not read.
    """

    @property
    def encoding_settings(self) -> dict[str, Any]:
        """What decides the latents of an image beside the weights; latents of other settings are another model's."""
        return {}

    @abstractmethod
    def embed(self, images: Tensor, proprio: Tensor | None = None) -> Tensor:
        """Embeddings e_t, each of its own frame alone: (B, T, E)."""

    @abstractmethod
    def filter_embeds(self, embeds: Tensor, actions: Tensor, *, sample: bool = False) -> LatentState:
        """States (B, T, ·) for embeddings of whole episodes, given the action a_t executed at each frame.

        s_t may depend on a_{t-1} and what came before, never on a_t. `sample` draws it where the model has a
        distribution, instead of taking the mean.
        """

    @abstractmethod
    def observe(
        self, images: Tensor, prev_actions: Tensor, state: Any = None, proprio: Tensor | None = None
    ) -> LatentState:
        """States (B, T, ·) for the next frames, given the action a_{t-1} before each and the state before the first.

        Where an episode starts, the state is None and the action, which nobody took, is zeros that mean nothing.
        """

    def expected_images(self, state: Any) -> Tensor:
        """What o_t was expected to be before it was seen, (B, C, H, W), by the state s_t (B, ·) it led to.

        Defined where the configuration says `predicts_images`.
        """
        raise NotImplementedError(f"{type(self).__name__} predicts no images.")
