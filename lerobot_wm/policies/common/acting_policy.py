"""The base class of the policies that choose actions."""

import logging
from collections import deque
from typing import Any, ClassVar

import torch
from lerobot.datasets.dataset_metadata import LeRobotDatasetMetadata
from torch import Tensor, nn

from lerobot_wm.constants import ACTION, TASK
from lerobot_wm.nn.mlp import MLP
from lerobot_wm.nn.normalize import Affine
from lerobot_wm.policies.common.acting_config import ActingConfig
from lerobot_wm.policies.common.actions import RelativeToState, RolloutNoise, action_range
from lerobot_wm.policies.common.config import PolicyConfig
from lerobot_wm.policies.common.features import Statistics, join_vectors, joined_statistics
from lerobot_wm.policies.common.policy import BasePolicy
from lerobot_wm.policies.common.tasks import check_tasks, tasks_to_learn

logger = logging.getLogger(__name__)

_RANGE_TOLERANCE = 0.05  # share of a dataset's range that noise in a few frames adds
_WHITE = 1.01  # resizing and floating point may exceed 1 a little; a camera's bytes exceed this


class ActingPolicy(BasePolicy):
    """Base of the policies that choose actions: tasks as one-hot ids, scaled proprioception and actions, action noise.

    Subclasses also define `observe`, `observation_dim`, `observation_networks`, `task_start` and `actor_chunk`.
    """

    config: ActingConfig
    has_memory: ClassVar[bool] = False  # whether it must read every frame, also those between two predictions

    def build(self) -> None:
        """Make the scalings."""
        self.state_scaling = Affine(self.config.state_dim)
        # The numbers of a chunk reach further with each step, where they are relative to the state at its first.
        steps = (self.chunk_size,) if self.chunk_size > 1 else ()
        self.action_scaling = Affine(*steps, self.config.action_dim)
        self.relative_to_state = RelativeToState(self.config)
        self._noise = RolloutNoise()
        self._actions: deque[Tensor] = deque()  # predicted and not executed yet, (B, A) each

    def fit_dataset(self, stats: Statistics, dataset_meta: LeRobotDatasetMetadata) -> None:
        """Scale proprioception to unit variance and actions to [-1, 1]."""
        self.state_scaling.set_standard(*joined_statistics(stats, self.config.state_vectors, "mean", "std"))
        self.action_scaling.set_range(*action_range(self.config, stats, dataset_meta, self.chunk_size))

    def scaled(self, action: Tensor, state: Tensor) -> Tensor:
        """Actions (B, A), or chunks of them (B, K, A), as the heads learn them, given proprioception (B, P)."""
        return self.action_scaling(self.relative_to_state(action, state))

    def unscaled(self, scaled: Tensor, state: Tensor) -> Tensor:
        """Undo `scaled`."""
        return self.relative_to_state.inverse(self.action_scaling.inverse(scaled), state)

    def state_at(self, batch: dict[str, Any], t: int | None = None) -> Tensor:
        """Proprioception of a batch in the dataset's units.

        Args:
            batch: Frames (B, ...), or windows of them (B, T, ...).
            t: Which frame of the windows; None where the batch holds frames.

        Returns:
            (B, P); P is 0 for a policy without proprioception.
        """
        frames = {key: batch[key] if t is None else batch[key][:, t] for key in self.config.state_vectors}
        state = join_vectors(frames, self.config.state_vectors)
        return self.state_scaling.offset.new_zeros(self.batch_size(batch), 0) if state is None else state

    def proprioception(self, state: Tensor) -> Tensor:
        """What the heads read of proprioception (B, P): scaled, and in training with `state_noise`."""
        scaled = self.state_scaling(state)
        if self.training and self.config.state_noise > 0:
            scaled = scaled + self.config.state_noise * torch.randn_like(scaled)
        return scaled

    def batch_size(self, batch: dict[str, Any]) -> int:
        """B of a batch, in training or at test time."""
        keys = (*self.config.input_features, ACTION)
        return next(len(batch[key]) for key in keys if isinstance(batch.get(key), Tensor))

    def continue_training(self, dataset_meta: LeRobotDatasetMetadata) -> None:
        """Also learn the dataset's new tasks."""
        super().continue_training(dataset_meta)
        tasks = tasks_to_learn(dataset_meta)
        self.config.trained_tasks = list(dict.fromkeys([*self.config.known_tasks, *tasks]))
        self.add_tasks(tasks)
        self.warn_if_actions_out_of_range(dataset_meta)

    def warn_if_actions_out_of_range(self, dataset_meta: LeRobotDatasetMetadata) -> None:
        """Warn of actions in a dataset that this policy, scaled as in its first training, cannot command."""
        ends = (torch.full_like(self.action_scaling.offset, end) for end in (-1.0, 1.0))
        ranges = (
            *action_range(self.config, dataset_meta.stats or {}, dataset_meta, self.chunk_size),
            *(self.action_scaling.inverse(end).cpu() for end in ends),
        )
        # (A,) each, on the CPU; of chunks the first step.
        low, high, lowest, highest = (each.view(-1, self.config.action_dim)[0] for each in ranges)
        tolerance = _RANGE_TOLERANCE * (high - low)
        outside = (low < lowest - tolerance) | (high > highest + tolerance)
        for i in torch.nonzero(outside).flatten().tolist():
            logger.warning(
                "Number %d of the actions ranges from %.3g to %.3g in %s; this policy was first trained on %.3g to "
                "%.3g and cannot command the rest. If that matters, train a new --policy.type=%s on both datasets.",
                *(i, low[i], high[i], dataset_meta.repo_id, lowest[i], highest[i], self.config.type),
            )

    def observation_networks(self) -> list[MLP]:
        """The networks that read the observation (B, O), and perhaps more after it."""
        raise NotImplementedError

    @property
    def observation_dim(self) -> int:
        """O, the size of what the heads read."""
        raise NotImplementedError

    @property
    def task_start(self) -> int:
        """Index in the observation at which the one-hot task id begins."""
        raise NotImplementedError

    @torch.no_grad()
    def add_tasks(self, tasks: list[str]) -> None:
        """Add tasks after the known ones, with zero weights, so that known tasks are acted on as before.

        Args:
            tasks: Task strings; known ones are skipped.
        """
        new = [task for task in tasks if task not in self.config.tasks]
        if not new:
            return
        for network in self.observation_networks():
            network.insert_inputs(self.task_start + len(self.config.tasks), len(new))
        logger.info("New tasks: %s; known ones: %s", new, self.config.tasks)
        self.config.tasks = [*self.config.tasks, *new]

    @property
    def chunk_size(self) -> int:
        """K, how many actions are predicted at once."""
        return 1

    @property
    def n_action_steps(self) -> int:
        """How many of them are executed before the next prediction."""
        return 1

    def observe(self, batch: dict[str, Any], state: Tensor) -> Tensor:
        """What the heads read, (B, O), of the next frame: a batch of `select_action` and its proprioception (B, P)."""
        raise NotImplementedError

    def actor_chunk(self, observation: Tensor, batch: dict[str, Any] | None = None) -> Tensor:
        """The policy's next actions (B, K, A), scaled to [-1, 1], for observations (B, O).

        A policy that samples them draws from the stream of each rollout in the batch of `select_action`, or without a
        batch takes the middle of its noise.
        """
        raise NotImplementedError

    def act(self, observation: Tensor, state: Tensor) -> Tensor:
        """The policy's next action, clipped to the dataset's range, in its units.

        Args:
            observation: What the heads read, (B, O).
            state: Proprioception in the dataset's units, (B, P).

        Returns:
            (B, A).
        """
        return self.unscaled(self.actor_chunk(observation).clamp(-1, 1), state)[:, 0]

    def reset(self) -> None:
        """Forget the episode; LeRobot calls this between episodes."""
        self._noise.reset()
        self.drop_queued_actions()

    def drop_queued_actions(self) -> None:
        """Forget the actions that were not executed yet; LeRobot after 0.6.1 calls this where a person took over."""
        self._actions.clear()

    def executed(self, action: Tensor) -> None:
        """Tell the policy which action was executed last, where it is not the one that `select_action` returned.

        Args:
            action: a_{t-1}, (B, A) in the dataset's units.
        """

    @torch.no_grad()
    def select_action(self, batch: dict[str, Any], **kwargs: Any) -> Tensor:
        """Read the next frame and act: the next of the predicted actions, clipped, and `action_noise`.

        Args:
            batch: Each camera (B, C, H, W) in [0, 1], proprioception such as `observation.state` (B, P), `task` (B
                strings), and `observation.environment_state` (B, F) with `use_environment_state`.
            **kwargs: Not used; LeRobot passes options of other policies.

        Returns:
            Actions in the dataset's units, (B, A).

        Raises:
            ValueError: A camera or a state is missing or has another size than in training, or the task is unknown.
        """
        has_next = self._actions and len(self._actions[0]) == self.batch_size(batch)
        if self.has_memory or not has_next:
            observation, state = self._observe(batch)
        if not has_next:
            self._actions = deque(self._chunk(observation, state, batch)[:, : self.n_action_steps].unbind(1))
        action = self._actions.popleft()
        self.executed(action)
        return action

    @torch.no_grad()
    def predict_action_chunk(self, batch: dict[str, Any], **kwargs: Any) -> Tensor:
        """Read the next frame and predict all its actions, (B, K, A) in the dataset's units.

        To be called at every frame: the filter takes the first action for executed, unless `executed` is called. The
        arguments and errors are those of `select_action`, whose queue of actions it leaves alone.
        """
        chunk = self._chunk(*self._observe(batch), batch)
        self.executed(chunk[:, 0])
        return chunk

    def _observe(self, batch: dict[str, Any]) -> tuple[Tensor, Tensor]:
        if self.training:  # no dropout and no random shifts, as LeRobot's policies act
            self.eval()
        check_observation(self.config, batch)
        state = self.state_at(batch)
        return self.observe(batch, state), state

    def _chunk(self, observation: Tensor, state: Tensor, batch: dict[str, Any]) -> Tensor:
        """Actions (B, K, A) in the dataset's units, with `action_noise`, clipped to the dataset's range."""
        chunk = self.actor_chunk(observation, batch).clamp(-1, 1)
        if self.config.action_noise > 0:
            noise = self._noise(chunk.flatten(1), batch).view_as(chunk)
            chunk = (chunk + self.config.action_noise * noise).clamp(-1, 1)
        return self.unscaled(chunk, state)

    def one_hot_tasks(self, batch: dict[str, Any], batch_size: int) -> Tensor:
        """One-hot task ids (B, N) from the batch's task strings, or from a single string for all of it.

        A policy that knows one task performs it whatever the string: simulators name tasks in their own words.

        Raises:
            ValueError: A policy of several tasks is given no string, or one that it was not trained on.
        """
        known = self.config.known_tasks
        given = batch.get(TASK) or [""] * batch_size  # lerobot-rollout gives "" when it was given none
        if isinstance(given, str):
            given = [given] * batch_size
        names = [known[0]] * batch_size if len(known) == 1 else given
        if "" in set(names) - set(known):
            raise ValueError(
                f"The batch has no '{TASK}' strings; this policy knows {len(known)} tasks: {known}. Give one of these "
                "strings (--task for lerobot-rollout)."
            )
        check_tasks(self.config, names)
        index = {task: i for i, task in enumerate(self.config.tasks)}
        ids = torch.tensor([index[name] for name in names], device=self.state_scaling.offset.device)
        return nn.functional.one_hot(ids, len(self.config.tasks)).float()


def check_observation(config: PolicyConfig, batch: dict[str, Any]) -> None:
    """Check what a policy is shown: each camera (B, C, H, W) in [0, 1], and vectors (B, N) such as `observation.state`.

    Raises:
        ValueError: A feature is missing or has another shape than in training, or images are not in [0, 1].
    """
    config.check_shapes(
        {key: tuple(value.shape[1:]) for key, value in batch.items() if isinstance(value, Tensor)}
    )
    for key in config.cameras:
        image = batch[key]
        if not image.is_floating_point() or image.max() > _WHITE:
            raise ValueError(
                f"'{key}' is {image.dtype} with a maximum of {image.max().item():g}; expected floating-point numbers "
                "in [0, 1]: divide a camera's bytes by 255, as prepare_observation_for_inference of "
                "lerobot.policies.utils does."
            )
