"""What all policies that act have in common: the task list, and scalings of proprioception and action."""

from typing import Any

import torch
from lerobot.datasets.dataset_metadata import LeRobotDatasetMetadata
from torch import Tensor, nn

from lerobot_wm.constants import ACTION, OBS_STATE, TASK
from lerobot_wm.nn.normalize import Affine
from lerobot_wm.policies.features import stat
from lerobot_wm.policies.multi_task_config import MultiTaskConfig
from lerobot_wm.policies.pretrained import StrictPolicy


class MultiTaskPolicy(StrictPolicy):
    """Base of the policies that act. Subclasses define `actor_mean`, `select_action` and `forward`."""

    config: MultiTaskConfig

    def __init__(
        self,
        config: MultiTaskConfig,
        dataset_stats: dict[str, dict[str, Any]] | None = None,
        dataset_meta: LeRobotDatasetMetadata | None = None,
    ) -> None:
        super().__init__(config)
        if dataset_meta is not None and not config.tasks:  # made new, not loaded from a checkpoint
            config.tasks = [str(task) for task in dataset_meta.tasks.index]
        config.validate_features()
        self.state_scaling = Affine(config.state_dim)
        self.action_scaling = Affine(config.action_dim)
        if dataset_stats is not None:  # a checkpoint's own values replace these when it is loaded
            self.state_scaling.set_standard(
                stat(dataset_stats, OBS_STATE, "mean"), stat(dataset_stats, OBS_STATE, "std")
            )
            self.action_scaling.set_range(
                stat(dataset_stats, ACTION, "min"), stat(dataset_stats, ACTION, "max")
            )

    def actor_mean(self, observation: Tensor) -> Tensor:
        """The policy's action (B, A), scaled to [-1, 1], for observations (B, O)."""
        raise NotImplementedError

    def one_hot_tasks(self, batch: dict[str, Any], batch_size: int) -> Tensor:
        """One-hot task ids (B, N) from the batch's task strings; one known task needs no string.

        Raises:
            ValueError: A task string is missing or is not one the policy was trained on.
        """
        known = self.config.tasks
        names = [known[0]] * batch_size if len(known) == 1 else batch.get(TASK)
        if names is None:
            raise ValueError(
                f"The batch has no '{TASK}' strings; this policy knows {len(known)} tasks: {known}."
            )
        unknown = set(names) - set(known)
        if unknown:
            raise ValueError(
                f"Unknown task {sorted(unknown)}; this policy was trained on {known}. Use one of these strings, or "
                "train a policy on a dataset that holds the new task."
            )
        index = torch.tensor([known.index(name) for name in names], device=self.state_scaling.offset.device)
        return nn.functional.one_hot(index, len(known)).float()

    def predict_action_chunk(self, batch: dict[str, Any], **kwargs: Any) -> Tensor:
        """`select_action` as a chunk of one: (B, 1, A)."""
        return self.select_action(batch, **kwargs)[:, None]
