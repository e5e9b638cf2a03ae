"""Sizes and loss weights of the world model."""

from dataclasses import dataclass


@dataclass
class RSSMConfig:
    """Sizes and loss weights of the paper's RSSM (section 3.1.1, on TorchRL's Dreamer layout).

    Args:
        deter_dim: Size of the deterministic state d_t.
        stoch_dim: Size of the stochastic state z_t.
        hidden_dim: Width of the layers around the GRU.
        reward_hidden_dim: Width of the reward head's two hidden layers.
        min_std: Lower bound of the standard deviations of prior and posterior.
        kl_scale: Weight β of the KL term.
        free_nats: KL per step (nats) below which the KL is not penalised.
        reward_scale: Weight of the reward loss.
        image_error_weight: w of the image loss e² (1 + w |e|), e in [-1, 1]; 0 is the paper's squared error. Above
            it, what is small and wrong weighs more.
        standardize_images: Scale each channel of the images by the dataset's mean and standard deviation where they
            enter and leave the model; the loss stays in [0, 1]. Off, as in the paper, the model first has to learn what
            the mean image is.
        decode_share: Share of each window's frames that are reconstructed, drawn anew in each step. More than half of a
            step goes into the decoder: with a fifth of the frames a CPU core makes almost twice as many steps.
        action_dropout: Share of the training windows in which the recurrence is not told the actions. Above 0 it is
            never told them where it filters. A demonstrator's action tells where the goal is as well as the image does:
            a model that is always told it has no reason to look, and a policy on its latents copies its own last
            action. Imagination is told the actions in any case; at 1 nothing was learned of what they do.
        action_scale: Weight of the action loss: a head predicts a_t from s_t, so that s_t holds what the demonstrator
            acted on, however small it is in the image. 0: no such head.
        image_shift: Pixels by which each training frame is shifted at random, up or down and left or right, before it
            is encoded; what is reconstructed is not shifted. Demonstrations of few goals can be told apart by what
            else is in the image, to the pixel; once that moves, the goal has to be located. Not for actions that are
            places in a fixed camera's image: the shift moves the place and not the action.
        predict_reward: Whether there is a reward head (turned off for datasets without `next.reward`).
        use_proprio: Encode and reconstruct proprioception beside the image (the paper's discarded variant).
        centred_start: What stands for the action before an episode is the middle of the actions' range. Filled when a
            model is made new; those of release 0.1.0 were trained with zeros in the dataset's units, which for joint
            angles may be far from all that the robot was ever told.
        image_channels: Channels of the image; filled from the dataset.
        action_dim: Size of the action; filled from the dataset.
        proprio_dim: Size of the proprioceptive state; filled from the dataset when `use_proprio`.
    """

    deter_dim: int = 256
    stoch_dim: int = 256
    hidden_dim: int = 256
    reward_hidden_dim: int = 400
    min_std: float = 0.1
    kl_scale: float = 1.0
    free_nats: float = 3.0
    reward_scale: float = 1.0
    image_error_weight: float = 0.0
    standardize_images: bool = False
    decode_share: float = 1.0
    action_dropout: float = 0.0
    action_scale: float = 0.0
    image_shift: int = 0
    predict_reward: bool = True
    use_proprio: bool = False
    centred_start: bool = False
    image_channels: int = 0
    action_dim: int = 0
    proprio_dim: int = 0

    def __post_init__(self) -> None:
        if not 0 < self.decode_share <= 1:
            raise ValueError(
                f"decode_share is {self.decode_share:g}; a share of frames is above 0 and at most 1."
            )
        if self.image_shift < 0:
            raise ValueError(f"image_shift is {self.image_shift}; it is pixels, 0 or more.")
        if not 0 <= self.action_dropout <= 1:
            raise ValueError(
                f"action_dropout is {self.action_dropout:g}; a share of windows is between 0 and 1."
            )
        if self.min_std <= 0:
            raise ValueError(f"min_std is {self.min_std:g}; a standard deviation is above 0.")
        for name in ("kl_scale", "free_nats", "reward_scale", "image_error_weight", "action_scale"):
            if getattr(self, name) < 0:
                raise ValueError(f"{name} is {getattr(self, name):g}; it is 0 or more.")

    @property
    def latent_dim(self) -> int:
        """Size of s_t = [d_t, z_t]."""
        return self.deter_dim + self.stoch_dim
