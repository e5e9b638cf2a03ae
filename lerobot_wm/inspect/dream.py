"""Dreams: the world model sees an episode's first frames, then imagines the rest under several kinds of action."""

from dataclasses import dataclass
from typing import Any

import torch
from torch import Tensor

from lerobot_wm.constants import ACTION, OBS_ENV_STATE, OBS_STATE, TASK
from lerobot_wm.inspect.episodes import reward_key, shapes_read
from lerobot_wm.inspect.open_loop import psnr
from lerobot_wm.policies.common.cameras import camera_images
from lerobot_wm.policies.latent.policy import LatentPolicy
from lerobot_wm.policies.wm_rssm.modeling_wm_rssm import WMRSSMPolicy
from lerobot_wm.world_model.model import WorldModel
from lerobot_wm.world_model.rssm import RSSMState

TRUE_ACTIONS, ZERO_ACTIONS, OWN_ACTIONS = "true actions", "zero actions", "policy's actions"


@dataclass(frozen=True)
class Dream:
    """What the world model makes of T frames: it reconstructs those it sees and imagines the others.

    `images` (T, K·C, 64, 64) are in [0, 1]. `reward` (T,) is the predicted reward that arrives with each frame, which
    for the first is none and means nothing; None without a reward head.
    """

    images: Tensor
    reward: Tensor | None


@dataclass(frozen=True)
class Dreams:
    """An episode's first T frames, of which `context` are seen, and dreams of them by kind of action, on the CPU.

    `truth` (T, K·C, 64, 64) holds the images of K cameras as the world model is shown them. `reward` (T,) is what
    arrived at frame t + 1, of the column `reward_key`; None where the dataset does not have it.
    """

    context: int
    n_cameras: int
    truth: Tensor
    reward: Tensor | None
    reward_key: str
    dreams: dict[str, Dream]

    def psnr(self) -> float:
        """PSNR in dB of the imagined images under true actions, over all steps together."""
        return self._psnr(self.dreams[TRUE_ACTIONS].images[self.context :])

    def copy_psnr(self) -> float:
        """The same of a copy of the last frame seen."""
        return self._psnr(self.truth[self.context - 1])

    def _psnr(self, images: Tensor) -> float:
        return psnr((images - self.truth[self.context :]).square().mean().item())


@torch.no_grad()
def dream(policy: WMRSSMPolicy | LatentPolicy, episode: dict[str, Any], context: int) -> Dreams:
    """Filter the first frames of an episode and imagine the others, always taking the mean of z_t.

    The kinds of action: those of the episode; zero in the environment's units, where nothing is commanded; and, for a
    policy, those it chooses from each imagined latent. While it acts in its dream its proprioception (and full state,
    where it reads that) is held at the last frame seen: the world model does not predict it, and what the dataset holds
    would tell the policy where the demonstration went.

    Args:
        policy: Holds the world model.
        episode: Its first T frames: each camera (T, C, H, W) in [0, 1], `action` (T, A), what else
            `shapes_read` names (T, ·), `task`, and the model's reward (T,) where there is one; as of `read_episodes`.
        context: How many of them the model sees.

    Raises:
        ValueError: The policy does not know the task.
    """
    config, world_model, key = policy.config, policy.world_model, reward_key(policy)
    assert isinstance(world_model, WorldModel)  # as load_world_model checked
    batch = {name: episode[name][None].to(config.device) for name in shapes_read(policy)}  # (1, T, ·) each
    images, actions = camera_images(config, batch), batch[ACTION]  # (1, T, K·C, 64, 64), (1, T, A)
    proprio = batch[OBS_STATE][:, :context] if world_model.config.use_proprio else None
    seen = world_model.filter(images[:, :context], actions[:, :context], proprio)
    # The first imagined step is reached by the action executed at the last frame seen.
    true_actions = actions[:, context - 1 : -1]  # (1, T - context, A)
    imagined = {
        TRUE_ACTIONS: world_model.imagine(seen.last(), true_actions).latent,
        ZERO_ACTIONS: world_model.imagine(seen.last(), torch.zeros_like(true_actions)).latent,
    }
    if isinstance(policy, LatentPolicy):
        last = {key: value[:, context - 1] for key, value in batch.items()} | {TASK: [episode[TASK]]}
        imagined[OWN_ACTIONS] = _act(policy, world_model, seen.last(), last, true_actions.shape[1])

    def told(latents: Tensor) -> Dream:
        """Decode imagined latents (1, T - context, L) together with those of the frames seen."""
        latents = torch.cat([seen.latent, latents], dim=1)  # (1, T, L)
        reward = world_model.predict_reward(latents)[0].cpu() if world_model.config.predict_reward else None
        return Dream(world_model.decode(latents)[0].cpu(), reward)

    return Dreams(
        context=context,
        n_cameras=len(config.cameras),
        truth=images[0].cpu(),
        reward=episode[key].float() if key in episode else None,  # next.success is stored as bool
        reward_key=key,
        dreams={name: told(latents) for name, latents in imagined.items()},
    )


def _act(
    policy: LatentPolicy, world_model: WorldModel, state: RSSMState, last: dict[str, Any], n_steps: int
) -> Tensor:
    """Latents (1, n_steps, L) that the policy's actions lead to from s_t (1, ·), given the rest of frame t."""
    tasks = policy.one_hot_tasks(last, 1)  # (1, N)
    env_state = last[OBS_ENV_STATE] if policy.config.use_environment_state else None
    latents = []
    for _ in range(n_steps):
        action = policy.act(last[OBS_STATE], tasks, state.latent, env_state)  # (1, A)
        state = world_model.imagine(state, action[:, None]).last()
        latents.append(state.latent)
    return torch.stack(latents, dim=1)
