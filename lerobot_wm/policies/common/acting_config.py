"""The settings that all policies share which choose actions."""

import logging
from dataclasses import dataclass, field
from typing import Self

from lerobot.datasets.dataset_metadata import LeRobotDatasetMetadata

from lerobot_wm.constants import ACTION, OBS_ENV_STATE, OBS_LATENT, OBS_STATE
from lerobot_wm.data.tables import relative_to_state
from lerobot_wm.policies.common.config import PolicyConfig, train_new
from lerobot_wm.policies.common.features import feature_dim
from lerobot_wm.policies.common.tasks import task_names, tasks_to_learn

logger = logging.getLogger(__name__)


@dataclass
class ActingConfig(PolicyConfig):
    """A policy that chooses actions: a head on [features of the images, one-hot task, proprioception].

    Args:
        hidden_dims: Widths of the hidden layers of every head.
        dropout: Dropout of the actor.
        state_noise: Standard deviation of Gaussian noise on proprioception in training, in standard deviations of the
            dataset's. From few episodes, a policy can learn which action follows which exact position of the joints,
            and need no image. Where the task needs the exact position, noise hurts.
        action_noise: Standard deviation of Gaussian noise on the actions at test time, in units in which the actions
            that the heads learn span [-1, 1]. It frees a policy that hovers in a place where no demonstration ends.
        relative_actions: Learn targets relative to the state: the heads learn a_t minus the measured state where the
            action is a target for it, such as a joint's position. The policy still returns the dataset's units. None
            finds these numbers in the dataset (see `data.tables.relative_to_state`), true takes all, false none.
        tasks: Task strings in one-hot order, taken from the dataset when the policy is created.
        trained_tasks: Those of them that the training episodes had; empty in older checkpoints, for all.
        relative_indices: Which numbers of the action these are, and of observation.state; filled when the policy is
            created.
    """

    hidden_dims: list[int] = field(default_factory=lambda: [256, 256])
    dropout: float = 0.1
    state_noise: float = 0.0
    action_noise: float = 0.0
    relative_actions: bool | None = None
    tasks: list[str] = field(default_factory=list)
    trained_tasks: list[str] = field(default_factory=list)
    relative_indices: list[int] = field(default_factory=list)

    def __post_init__(self) -> None:
        super().__post_init__()
        for name, value in vars(self).items():
            if name.endswith("_noise") and value < 0:
                raise ValueError(f"--policy.{name}={value:g}: a standard deviation is 0 or more.")

    @property
    def action_dim(self) -> int:
        """Size of the action."""
        return feature_dim(self.output_features, ACTION)

    @property
    def known_tasks(self) -> list[str]:
        """The tasks that the policy was trained on."""
        return self.trained_tasks or self.tasks

    def fill_from_dataset(self, dataset_meta: LeRobotDatasetMetadata) -> None:
        """Take the tasks and the numbers that are relative to the state; name vectors that are there and not read."""
        self.tasks, self.trained_tasks = task_names(dataset_meta), tasks_to_learn(dataset_meta)
        self.relative_indices = self._choose_relative(dataset_meta)
        unread = [
            key
            for key, feature in dataset_meta.features.items()
            if key.startswith("observation.")
            and feature["dtype"].startswith(("float", "int"))
            and len(feature["shape"]) == 1
            and key not in (*self.state_vectors, OBS_ENV_STATE, OBS_LATENT)
        ]
        if unread:
            logger.info(
                "Not read: %s. --policy.state_keys=%s reads them as proprioception.",
                ", ".join(unread),
                ",".join([*self.state_vectors, *unread]),
            )

    def _choose_relative(self, dataset_meta: LeRobotDatasetMetadata) -> list[int]:
        if self.relative_actions is False or OBS_STATE not in self.state_vectors:
            chosen: list[int] = []
        elif self.relative_actions is None:
            chosen = relative_to_state(dataset_meta)
        else:
            chosen = list(range(self.action_dim))
            size = feature_dim(self.input_features, OBS_STATE)
            if size != self.action_dim:
                raise ValueError(
                    f"--policy.relative_actions=true: the action has {self.action_dim} numbers and the '{OBS_STATE}' "
                    f"that the policy reads {size}; expected as many. Leave the flag out."
                )
        if chosen:
            logger.info(
                "%d of the action's %d numbers are targets for the state, and are learned relative to it "
                "(--policy.relative_actions=false learns them as recorded).",
                len(chosen),
                self.action_dim,
            )
        return chosen

    def check_unchanged(self, saved: Self) -> None:
        """Also check that actions stay relative to the state, or absolute, as they were learned."""
        super().check_unchanged(saved)
        if self.relative_actions != saved.relative_actions:
            raise ValueError(
                f"--policy.relative_actions={self.relative_actions}: this {saved.type} was trained with "
                f"{saved.relative_actions}. Leave the flag out, or {train_new(saved)}."
            )

    @property
    def relative_state_indices(self) -> list[int]:
        """Where the numbers of `relative_indices` are in the proprioceptive state."""
        vectors = self.state_vectors
        before = vectors[: vectors.index(OBS_STATE)] if OBS_STATE in vectors else []
        start = sum(feature_dim(self.input_features, key) for key in before)
        return [start + index for index in self.relative_indices]
