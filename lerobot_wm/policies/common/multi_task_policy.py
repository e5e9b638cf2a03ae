"""What all policies that act have in common: the task list, and scalings of proprioception and action."""

import logging
from typing import Any, Self

import torch
from lerobot.datasets.dataset_metadata import LeRobotDatasetMetadata
from torch import Tensor, nn

from lerobot_wm.constants import ACTION, OBS_STATE, TASK
from lerobot_wm.nn.mlp import MLP
from lerobot_wm.nn.normalize import Affine
from lerobot_wm.policies.common.action_noise import ActionNoise
from lerobot_wm.policies.common.features import check_has_stats, stat
from lerobot_wm.policies.common.multi_task_config import MultiTaskConfig
from lerobot_wm.policies.common.policy import StrictPolicy

logger = logging.getLogger(__name__)

_SLACK = 0.05  # of a dataset's range: what noise in a few frames adds


class MultiTaskPolicy(StrictPolicy):
    """Base of the policies that act.

    Subclasses define `heads`, `task_offset`, `actor_mean`, `select_action` and `forward`.
    """

    config: MultiTaskConfig

    def __init__(
        self,
        config: MultiTaskConfig,
        dataset_stats: dict[str, dict[str, Any]] | None = None,
        dataset_meta: LeRobotDatasetMetadata | None = None,
    ) -> None:
        super().__init__(config)
        check_has_stats(dataset_meta)
        # Made new, not loaded from a checkpoint: its settings may be those of another policy, tasks and all.
        if dataset_meta is not None and (dataset_stats is not None or not config.tasks):
            config.tasks = [str(task) for task in dataset_meta.tasks.index]
        config.validate_features()
        self.state_scaling = Affine(config.state_dim)
        self.action_scaling = Affine(config.action_dim)
        self._action_noise = ActionNoise(config.action_noise)
        if dataset_stats is not None:  # made new: a checkpoint has its own
            self.state_scaling.set_standard(
                stat(dataset_stats, OBS_STATE, "mean"), stat(dataset_stats, OBS_STATE, "std")
            )
            self.action_scaling.set_range(
                stat(dataset_stats, ACTION, "min"), stat(dataset_stats, ACTION, "max")
            )

    @classmethod
    def from_pretrained(
        cls,
        pretrained_name_or_path: Any,
        *,
        dataset_meta: LeRobotDatasetMetadata | None = None,
        **kwargs: Any,
    ) -> Self:
        """Load a checkpoint; when it is to be trained on, make room for the dataset's new tasks. See `StrictPolicy`."""
        policy = super().from_pretrained(pretrained_name_or_path, dataset_meta=dataset_meta, **kwargs)
        if dataset_meta is not None:
            policy.add_tasks([str(task) for task in dataset_meta.tasks.index])
            policy.tell_of_actions_out_of_range(dataset_meta)
        return policy

    def tell_of_actions_out_of_range(self, dataset_meta: LeRobotDatasetMetadata) -> None:
        """Warn of a dataset whose actions lie where this policy's, scaled as in its first training, cannot go."""
        stats = dataset_meta.stats or {}
        low, high = stat(stats, ACTION, "min"), stat(stats, ACTION, "max")  # (A,)
        ends = (torch.full_like(self.action_scaling.offset, end) for end in (-1.0, 1.0))
        lowest, highest = (
            self.action_scaling.inverse(end).cpu() for end in ends
        )  # (A,), like the statistics
        slack = _SLACK * (high - low)
        for i in torch.nonzero((low < lowest - slack) | (high > highest + slack)).flatten().tolist():
            logger.warning(
                "Number %d of the actions goes from %.3g to %.3g in %s; this policy was first trained on %.3g to %.3g "
                "and cannot command the rest. If it matters, train anew with --policy.type=%s on both datasets.",
                *(i, low[i], high[i], dataset_meta.repo_id, lowest[i], highest[i], self.config.type),
            )

    def heads(self) -> list[MLP]:
        """The networks that read the observation (B, O), and maybe more after it."""
        raise NotImplementedError

    @property
    def task_offset(self) -> int:
        """Where in the observation the one-hot task id begins."""
        raise NotImplementedError

    @torch.no_grad()
    def add_tasks(self, tasks: list[str]) -> None:
        """Learn of further tasks: their places in the one-hot come after the known ones', with weights of zero.

        Known tasks are acted on as before. A new one begins as what the policy does regardless of the task.

        Args:
            tasks: Task strings; known ones are passed over.
        """
        new = [task for task in tasks if task not in self.config.tasks]
        if not new:
            return
        place = self.task_offset + len(self.config.tasks)
        for head in self.heads():
            head.insert_inputs(place, len(new))
        self.config.tasks = [*self.config.tasks, *new]
        logger.info("New tasks: %s; known ones: %s", new, self.config.tasks[: -len(new)])

    def actor_mean(self, observation: Tensor) -> Tensor:
        """The policy's action (B, A), scaled to [-1, 1], for observations (B, O)."""
        raise NotImplementedError

    def reset(self) -> None:
        """Forget the episode; LeRobot calls this between episodes."""
        self._action_noise.reset()

    def with_noise(self, action: Tensor, batch: dict[str, Any]) -> Tensor:
        """Actions (B, A) with `config.action_noise`, clipped to the dataset's range; `batch` is `select_action`'s."""
        if self.config.action_noise == 0:
            return action
        noisy = self._action_noise(self.action_scaling(action), batch)  # (B, A)
        return self.action_scaling.inverse(noisy.clamp(-1, 1))

    def one_hot_tasks(self, batch: dict[str, Any], batch_size: int) -> Tensor:
        """One-hot task ids (B, N) from the batch's task strings, or from one for all of it.

        A policy that knows one task does it whatever it is told: simulators name theirs in other words.

        Raises:
            ValueError: A policy of several tasks is given no string, or one that it was not trained on.
        """
        known = self.config.tasks
        given = batch.get(TASK) or [""] * batch_size  # lerobot-rollout gives "" where it was given none
        if isinstance(given, str):
            given = [given] * batch_size
        names = [known[0]] * batch_size if len(known) == 1 else given
        if "" in set(names) - set(known):
            raise ValueError(
                f"The batch has no '{TASK}' strings; this policy knows {len(known)} tasks: {known}. Name one of them, "
                "letter by letter (by --task for lerobot-rollout)."
            )
        self.config.check_tasks(names)
        places = {task: place for place, task in enumerate(known)}
        index = torch.tensor([places[name] for name in names], device=self.state_scaling.offset.device)
        return nn.functional.one_hot(index, len(known)).float()

    def predict_action_chunk(self, batch: dict[str, Any], **kwargs: Any) -> Tensor:
        """`select_action` as a chunk of one: (B, 1, A)."""
        return self.select_action(batch, **kwargs)[:, None]
