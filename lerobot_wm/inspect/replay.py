"""`lerobot-wm replay`: how far policies are from the recorded actions of a dataset, without a robot.

A policy is shown the recorded images and states, and its actions are compared with the recorded ones. The result
depends on which earlier actions its memory gets: on a robot they are its own, so that its small errors feed back.
"""

import copy
import json
import math
from collections.abc import Iterator
from dataclasses import dataclass, field
from itertools import groupby
from operator import itemgetter
from pathlib import Path
from typing import Any

import draccus
import numpy as np
import torch
from lerobot.datasets.dataset_metadata import LeRobotDatasetMetadata
from lerobot.datasets.lerobot_dataset import LeRobotDataset
from lerobot.policies import PreTrainedPolicy, make_pre_post_processors
from lerobot.policies.factory import get_policy_class
from matplotlib.figure import Figure
from rich.console import Console
from torch import Tensor
from tqdm import tqdm

from lerobot_wm.constants import ACTION, OBS_STATE, TASK
from lerobot_wm.data.source import SourceConfig
from lerobot_wm.files import write_whole
from lerobot_wm.inspect.episodes import CheckpointConfig, check_episodes, episodes_by_task
from lerobot_wm.inspect.pictures import PNG, figure_bytes
from lerobot_wm.policies.common.actions import RolloutNoise
from lerobot_wm.policies.common.checkpoint import checkpoint_file, open_checkpoint, read_json, split_revision
from lerobot_wm.policies.common.checks import check_reads
from lerobot_wm.policies.common.config import PolicyConfig
from lerobot_wm.policies.latent.policy import LatentPolicy
from lerobot_wm.system import quiet, silence
from lerobot_wm.tables import Measurement, ReportTable, terminal_tables

OWN, RECORDED = "own actions fed back", "recorded actions fed back"
REPLAY_NAME = "replay.json"
HOLD, REPEAT = "hold the state", "repeat the last recorded action"
# Frames of full size that are decoded together.
_FRAMES_AT_ONCE = 16


@dataclass
class ReplayConfig:
    """Flags of `lerobot-wm replay`.

    Args:
        policy: Folder or Hub id of a policy's checkpoint: one of ours that acts, or LeRobot's own, such as ACT.
        dataset: The recorded dataset, with images.
        compare: More checkpoints, shown the same frames; the blind policy (`--policy.use_latent=false`), for example.
        episodes: Indices of episodes. None takes those that the first policy was not trained on, or all where it was
            trained on all.
        output_dir: Where replay.json and a figure of each episode are written.
    """

    policy: CheckpointConfig
    dataset: SourceConfig
    compare: list[str] = field(default_factory=list)
    episodes: list[int] | None = None
    output_dir: Path = Path("outputs/replay")


class Replayed:
    """A policy that is shown recorded frames one after another.

    Args:
        name: Its name in the tables.
        path: Folder or Hub id of its checkpoint.
        meta: The dataset it is shown.

    Raises:
        FileNotFoundError, CheckpointError: See `open_checkpoint`.
        ValueError: A policy of this package cannot read the dataset.
    """

    def __init__(self, name: str, path: str, meta: LeRobotDatasetMetadata) -> None:
        self.name = name
        config = open_checkpoint(path, with_processors=False)
        if isinstance(config, PolicyConfig):
            if not config.chooses_actions:
                raise ValueError(
                    f"{path} ({config.type}) chooses no actions: give a policy trained on its latents, or look at it "
                    "with `lerobot-wm dream`."
                )
            check_reads(config, meta)
        open_checkpoint(path)
        folder, revision = split_revision(path)
        policy_class = get_policy_class(config.type)
        self.policy: PreTrainedPolicy = policy_class.from_pretrained(
            folder, config=config, revision=revision
        ).eval()
        device = {"device_processor": {"device": str(config.device)}}  # it may have been trained on another
        self._before, self._after = make_pre_post_processors(
            config, pretrained_path=folder, pretrained_revision=revision, preprocessor_overrides=device
        )
        self.keys = list(config.input_features)
        # Where the filter reads actions, a second policy is given the recorded ones. It shares the networks, and has a
        # memory and random numbers of its own.
        self._with_recorded = copy.copy(self.policy) if _reads_actions(self.policy) else None
        if self._with_recorded is not None:
            self._with_recorded._noise = RolloutNoise()

    def reset(self) -> None:
        """Begin an episode."""
        self.policy.reset()
        if self._with_recorded is not None:
            self._with_recorded.reset()

    def actions(self, frame: dict[str, Any], last_action: Tensor | None) -> dict[str, Tensor]:
        """The action (A,) for the next frame of the episode, by what the policy's memory was given.

        Args:
            frame: Its features without a batch, and the task.
            last_action: The action recorded at the frame before it; None at the first.
        """
        batch = self._before({key: frame[key] for key in (*self.keys, TASK)})
        actions = {OWN: self._act(self.policy, batch)}
        if self._with_recorded is not None:
            if last_action is not None:
                self._with_recorded.executed(last_action[None])
            actions[RECORDED] = self._act(self._with_recorded, batch)
        return actions

    def _act(self, policy: PreTrainedPolicy, batch: dict[str, Any]) -> Tensor:
        return self._after(policy.select_action(batch))[0].float().cpu()


@dataclass(frozen=True)
class Replay:
    """Recorded actions and those of policies.

    Attributes:
        recorded: The actions of each episode by its index, (T, A).
        actions: The same of each policy and reference, by its label.
        std: Standard deviation of each number of the action over the dataset, (A,).
        joints: The names of the numbers.
        held_out: The episodes that the first policy was not trained on.
    """

    recorded: dict[int, np.ndarray]
    actions: dict[str, dict[int, np.ndarray]]
    std: np.ndarray
    joints: list[str]
    held_out: set[int]

    def errors(self, label: str, episodes: list[int]) -> np.ndarray:
        """Mean absolute error (A,) in the action's units over all frames of some episodes."""
        off = [np.abs(self.actions[label][e] - self.recorded[e]) for e in episodes]
        return np.concatenate(off).mean(0)

    def in_std(self, errors: np.ndarray) -> np.ndarray:
        """Errors (A,) in standard deviations, without the numbers that never change."""
        moves = self.std > 0
        return errors[moves] / self.std[moves]

    @property
    def groups(self) -> dict[str, list[int]]:
        """The replayed episodes: those that were held out from training, and the others."""
        groups = {
            "held out": [e for e in self.recorded if e in self.held_out],
            "trained": [e for e in self.recorded if e not in self.held_out],
        }
        return {name: episodes for name, episodes in groups.items() if episodes}


def _reads_actions(policy: PreTrainedPolicy) -> bool:
    """Whether what a policy does depends on the actions that were executed before."""
    if not isinstance(policy, LatentPolicy) or not policy.config.use_latent:
        return False
    return "hidden_actions" not in policy.world_model.encoding_settings


def replay(cfg: ReplayConfig) -> Replay:
    """Show the recorded frames to all policies.

    Raises:
        ValueError: An episode does not exist, or a policy cannot read the dataset.
    """
    with quiet():
        meta = cfg.dataset.metadata(cfg.episodes)
        paths = [cfg.policy.path, *cfg.compare]
        policies = [Replayed(name, path, meta) for name, path in zip(_names(paths), paths, strict=True)]
        trained = trained_episodes(cfg.policy.path, meta)
    held_out = set(range(meta.total_episodes)) - trained
    episodes = sorted(held_out or trained) if cfg.episodes is None else sorted(set(cfg.episodes))
    check_episodes(meta, episodes)
    keys = {key for policy in policies for key in policy.keys}
    missing = sorted(keys - meta.features.keys())
    if missing:
        raise ValueError(
            f"{meta.repo_id} has no {', '.join(missing)}, which a policy reads; it has {list(meta.features)}."
        )
    shapes = {key: tuple(feature["shape"]) for key, feature in meta.features.items()}
    has_state = shapes.get(OBS_STATE) == shapes[ACTION]
    keys |= {ACTION, OBS_STATE} if has_state else {ACTION}
    recorded: dict[int, np.ndarray] = {}
    actions: dict[str, dict[int, np.ndarray]] = {}
    stream = _frames(meta, cfg.dataset, episodes, sorted(keys))
    for episode, frames in groupby(stream, key=itemgetter(0)):
        chosen: dict[str, list[Tensor]] = {}
        for policy in policies:
            policy.reset()
        last: Tensor | None = None
        truth: list[Tensor] = []
        for _, frame in frames:
            for policy in policies:
                for given, action in policy.actions(frame, last).items():
                    chosen.setdefault(f"{policy.name}, {given}", []).append(action)
            truth.append(frame[ACTION].float())
            chosen.setdefault(REPEAT, []).append(truth[-1] if last is None else last)
            if has_state:
                chosen.setdefault(HOLD, []).append(frame[OBS_STATE].float())
            last = truth[-1]
        recorded[episode] = torch.stack(truth).numpy()
        for label, of_episode in chosen.items():
            actions.setdefault(label, {})[episode] = torch.stack(of_episode).numpy()
    std = np.asarray((meta.stats or {})[ACTION]["std"], dtype=np.float64)
    return Replay(recorded, actions, std, joint_names(meta), held_out)


def _frames(
    meta: LeRobotDatasetMetadata, source: SourceConfig, episodes: list[int], keys: list[str]
) -> Iterator[tuple[int, dict[str, Any]]]:
    """The frames of episodes, in order, each with its episode's index; a frame has these features and `task`."""
    times = [step / meta.fps for step in range(_FRAMES_AT_ONCE)]
    dataset = LeRobotDataset(
        source.repo_id,
        root=source.root,
        revision=source.revision,
        episodes=episodes,
        delta_timestamps=dict.fromkeys(keys, times),
    )
    lengths, tasks = meta.episodes["length"][:], meta.episodes["tasks"][:]
    indices = [episode for episode in episodes for _ in range(lengths[episode])]
    steps = [step for episode in episodes for step in range(lengths[episode])]
    for row, (episode, step) in enumerate(zip(tqdm(indices, "Replaying", unit="frame"), steps, strict=True)):
        if step % _FRAMES_AT_ONCE == 0:
            window = dataset[row]
        # LeRobot drops the axis of vectors of one number.
        frame = {key: torch.atleast_1d(window[key][step % _FRAMES_AT_ONCE]) for key in keys}
        yield episode, frame | {TASK: tasks[episode][0]}


def trained_episodes(path: str, meta: LeRobotDatasetMetadata) -> set[int]:
    """The dataset's episodes that a checkpoint was trained on, by the configuration beside it; all where it has none.

    LeRobot's `--dataset.eval_split` holds out the last episodes of each task.
    """
    folder, revision = split_revision(path)
    file = checkpoint_file(folder, "train_config.json", revision)
    settings = {} if file is None else read_json(file)["dataset"]
    episodes = set(settings.get("episodes") or range(meta.total_episodes))
    share = settings.get("eval_split") or 0.0
    trained = set()
    for of_task in episodes_by_task(meta).values():
        chosen = [episode for episode in of_task if episode in episodes]
        trained |= set(chosen[: len(chosen) - math.ceil(len(chosen) * share)])
    return trained


def joint_names(meta: LeRobotDatasetMetadata) -> list[str]:
    """The names of the action's numbers; their indices where the dataset does not name them, or two alike."""
    names, size = meta.features[ACTION].get("names"), meta.features[ACTION]["shape"][0]
    while isinstance(names, dict) and len(names) == 1:
        [names] = names.values()
    if isinstance(names, list) and len(names) == 1 and isinstance(names[0], list):
        [names] = names
    return (
        [str(name) for name in names]
        if isinstance(names, list) and len(set(map(str, names))) == size
        else list(map(str, range(size)))
    )


def _names(paths: list[str]) -> list[str]:
    """A short name for each checkpoint: its run's folder, or its Hub id."""
    runs = [path.split("/checkpoints/")[0].rstrip("/").rsplit("/", 1)[-1] for path in paths]
    return runs if len(set(runs)) == len(runs) else paths


def replay_table(content: dict[str, Any]) -> ReportTable:
    """The table of a replay.json: policies and references down, held-out and trained episodes across."""
    rows = [
        (
            label,
            [Measurement(f"{mean:.3f}", f"worst {worst:.2f}") for mean, worst in zip(*cells, strict=True)],
        )
        for label, means in content["error_in_std"].items()
        for cells in [(means.values(), content["worst_joint_in_std"][label].values())]
    ]
    counts = content["n_episodes"]
    notes = [
        "Mean absolute error of the action in standard deviations of the dataset's actions; beside it that of the "
        f"joint that is furthest off. Episodes: {', '.join(f'{n} {name}' for name, n in counts.items())}."
    ]
    return ReportTable("Replay of recorded episodes", "policy", list(counts), rows, notes=notes)


def as_json(result: Replay) -> dict[str, Any]:
    """The content of replay.json: errors of each policy, episode and joint, in units and in standard deviations."""
    rows = [
        {
            "policy": label,
            "episode": episode,
            "held_out": episode in result.held_out,
            "frames": len(result.recorded[episode]),
            "error_in_std": float(result.in_std(errors).mean()),
            "error": dict(zip(result.joints, map(float, errors), strict=True)),
        }
        for label in result.actions
        for episode in result.recorded
        for errors in [result.errors(label, [episode])]
    ]
    in_std = {
        label: {
            name: result.in_std(result.errors(label, episodes)) for name, episodes in result.groups.items()
        }
        for label in result.actions
    }
    std = dict(zip(result.joints, map(float, result.std), strict=True))
    return {
        "error_in_std": {
            label: {name: float(e.mean()) for name, e in g.items()} for label, g in in_std.items()
        },
        "worst_joint_in_std": {
            label: {name: float(e.max()) for name, e in g.items()} for label, g in in_std.items()
        },
        "n_episodes": {name: len(episodes) for name, episodes in result.groups.items()},
        "action_std": std,
        "episodes": rows,
    }


def replay_figure(result: Replay, episode: int, fps: float) -> Figure:
    """Recorded actions and those of the policies over an episode, a panel for each number of the action."""
    n_joints = len(result.joints)
    columns = min(4, n_joints)
    rows = math.ceil(n_joints / columns)
    figure = Figure(figsize=(3.4 * columns, 1.6 * rows + 0.5), layout="constrained")
    panels = figure.subplots(rows, columns, squeeze=False, sharex=True).flat
    seconds = np.arange(len(result.recorded[episode])) / fps
    shown = [label for label in result.actions if label.endswith(OWN)]
    for joint, (panel, name) in enumerate(zip(panels, result.joints, strict=False)):
        panel.plot(
            seconds, result.recorded[episode][:, joint], color="black", linewidth=1.5, label="recorded"
        )
        for label in shown:
            panel.plot(seconds, result.actions[label][episode][:, joint], linewidth=1, label=label)
        panel.set_title(name, fontsize=8)
        panel.tick_params(labelsize=7)
    for panel in list(figure.axes)[n_joints:]:
        panel.set_axis_off()
    for panel in figure.axes[n_joints - columns : n_joints]:
        panel.set_xlabel("seconds", fontsize=7)
    handles, labels = figure.axes[0].get_legend_handles_labels()
    figure.legend(handles, labels, loc="outside lower center", ncols=3, fontsize=8)
    return figure


def main() -> None:
    """Entry point of `lerobot-wm replay`."""
    silence()
    cfg = draccus.parse(ReplayConfig)
    result = replay(cfg)
    cfg.output_dir.mkdir(parents=True, exist_ok=True)
    fps = cfg.dataset.metadata(cfg.episodes).fps
    for episode in result.recorded:
        figure = replay_figure(result, episode, fps)
        (cfg.output_dir / f"episode_{episode}.png").write_bytes(figure_bytes(figure, PNG))
    content = as_json(result)
    write_whole(cfg.output_dir / REPLAY_NAME, json.dumps(content, indent=1))
    Console(width=100).print(*terminal_tables(replay_table(content)))
    print(f"Errors of each joint: {cfg.output_dir / REPLAY_NAME}; figures beside it.")
