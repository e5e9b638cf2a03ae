"""Sizes and loss weights of the world model."""

from dataclasses import dataclass

from lerobot_wm.nn.conv import ACTIVATIONS


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
        standardize_images: Scale each image channel by the dataset's mean and standard deviation at the model's input
            and output; the loss is still computed on [0, 1]. Without it, as in the paper, the model first has to learn
            the mean image.
        decode_share: Share of each window's frames that are reconstructed, drawn again at each step. The decoder takes
            more than half of a step: with a share of 0.2 a CPU core makes almost twice as many steps.
        hidden_action_share: Share of the training windows in which the filter is not given the previous actions. Above
            0 the filter never gets them at test time. A demonstrator's action reveals the goal as well as the image
            does: a model that always gets it has no reason to look, and a policy on its latents copies its own last
            action. Imagination always gets the actions; with a share of 1 it learned nothing about them. None takes 0;
            wm_rssm replaces it by 0.5 for data whose last action predicts the next, such as joint targets.
        action_scale: Weight of the action loss. A head predicts a_t from s_t, so that s_t holds what the demonstrator
            reacted to, however small it is in the image. 0 removes the head.
        action_horizon: Number K of actions a_t ... a_{t+K-1} that this head predicts. A target of the joints is almost
            where the arm is seen to be; the targets of half a second later tell where the object lies.
        image_shift: Largest random shift of a training frame before it is encoded, in pixels; the reconstruction target
            is not shifted. With demonstrations of few goals, the model could recognize each one by its exact pixels;
            under shifts it has to locate the goal.
        n_keypoints: Number of keypoints that the encoder looks for; e_t is their coordinates, and the decoder is
            normalized. 0 flattens feature maps, as in the paper.
        encoder_activation: "relu", as in the paper, or "elu". Under ReLU most units of the encoder soon output zero for
            every image, and what is left says little of objects that training did not show.
        predict_reward: Whether there is a reward head. Turned off for datasets without a reward.
        use_proprio: Encode and reconstruct proprioception beside the image (the variant that the paper discarded).
        image_size: Height and width S of the images that the model sees, a multiple of 16; the paper's is 64. Time and
            memory grow with its square.
        image_channels: Channels of the image. Set from the dataset.
        action_dim: Size of the action. Set from the dataset.
        proprio_dim: Size of the proprioceptive state. Set from the dataset when `use_proprio`.
    """

    deter_dim: int = 256
    stoch_dim: int = 256
    hidden_dim: int = 256
    reward_hidden_dim: int = 400
    min_std: float = 0.1
    kl_scale: float = 1.0
    free_nats: float = 3.0
    reward_scale: float = 1.0
    standardize_images: bool = False
    decode_share: float = 1.0
    hidden_action_share: float | None = None
    action_scale: float = 0.0
    action_horizon: int = 1
    image_shift: int = 0
    n_keypoints: int = 0
    encoder_activation: str = "relu"
    predict_reward: bool = True
    use_proprio: bool = False
    image_size: int = 64
    image_channels: int = 0
    action_dim: int = 0
    proprio_dim: int = 0

    def __post_init__(self) -> None:
        if not 0 < self.decode_share <= 1:
            raise ValueError(f"decode_share is {self.decode_share:g}; expected above 0 and at most 1.")
        if not 0 <= (self.hidden_action_share or 0) <= 1:
            raise ValueError(f"hidden_action_share is {self.hidden_action_share:g}; expected 0 to 1.")
        if self.image_size < 32 or self.image_size % 16:
            raise ValueError(f"image_size is {self.image_size}; expected a multiple of 16, at least 32.")
        if self.encoder_activation not in ACTIVATIONS:
            raise ValueError(
                f"encoder_activation is {self.encoder_activation!r}; expected one of {', '.join(ACTIVATIONS)}."
            )
        if self.min_std <= 0:
            raise ValueError(f"min_std is {self.min_std:g}; expected a standard deviation above 0.")
        if self.action_horizon < 1:
            raise ValueError(f"action_horizon is {self.action_horizon}; expected at least 1 action.")
        for name in ("kl_scale", "free_nats", "reward_scale", "action_scale", "image_shift", "n_keypoints"):
            if getattr(self, name) < 0:
                raise ValueError(f"{name} is {getattr(self, name):g}; expected 0 or more.")

    @property
    def latent_dim(self) -> int:
        """Size of s_t = [d_t, z_t]."""
        return self.deter_dim + self.stoch_dim
