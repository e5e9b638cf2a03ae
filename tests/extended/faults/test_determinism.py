"""The same seed gives the same again, whatever was drawn before, at any batch size and in any order; another does not.

That the number of processes, workers or jobs changes nothing, nor an interruption, is tested where those are:
test_kill_collection, test_shards, test_evaluate, test_train_processes, test_kill_commands.
"""

import random
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch
from lerobot.datasets.lerobot_dataset import LeRobotDataset

from lerobot_wm.collect.shards import SHARD_RECORD, Shard, write_shard
from lerobot_wm.constants import MT6, REPORTED_VARIATION_SET, VARIATION_SETS
from lerobot_wm.encode.dataset import episode_batches, filter_batches
from lerobot_wm.envs.configuration import MetaworldMTEnvConfig
from lerobot_wm.envs.metaworld_mt import MetaworldMTEnv
from lerobot_wm.envs.variations import rand_vec
from lerobot_wm.evaluate.rollouts import variation_of
from lerobot_wm.policies.latent.policy import load_encoder
from lerobot_wm.records import Record, read_records
from lerobot_wm.system import quiet
from tests.extended.faults.running import Inputs
from tests.flags import SMALL_WORLD_MODEL, TRAIN_FLAGS


def draw(seed: int) -> None:
    """Leave the global random numbers as some other work would."""
    random.seed(seed)
    np.random.seed(seed)
    torch.manual_seed(seed)


def files(root: Path) -> dict[str, bytes]:
    """All but the record, which holds a time."""
    paths = [path for path in root.rglob("*") if path.is_file() and path.name != SHARD_RECORD]
    return {path.relative_to(root).as_posix(): path.read_bytes() for path in paths}


def test_collection(tmp_path: Path) -> None:
    shards = []
    for drawn, seed in enumerate((0, 0, 1)):
        shard = Shard("reach-v3", 0, 2, REPORTED_VARIATION_SET, (0, 1), 0.3, 2, 1, seed, 32, ("corner2",))
        draw(drawn)
        with quiet():
            write_shard(shard, tmp_path / str(drawn))
        shards.append(files(tmp_path / str(drawn) / shard.name))
    once, again, other = shards
    assert once == again
    assert once.keys() == other.keys()
    assert once["data/chunk-000/file-000.parquet"] != other["data/chunk-000/file-000.parquet"]


@pytest.mark.parametrize("policy_type", ["wm_rssm", "wm_bc", "wm_iql"])
def test_training(
    policy_type: str, inputs: Inputs, tmp_path: Path, lerobot_wm_command: Callable[..., None]
) -> None:
    flags = {
        "wm_rssm": f"--policy.window_length=4 {SMALL_WORLD_MODEL} --dataset.root={inputs.dataset}",
        "wm_bc": f"--policy.world_model_path={inputs.world_model} --dataset.root={inputs.latents}",
        "wm_iql": f"--policy.world_model_path={inputs.world_model} --dataset.root={inputs.latents}",
    }[policy_type]
    weights = []
    for drawn, (seed, workers) in enumerate(((0, 0), (0, 2), (1, 0))):
        draw(drawn)
        lerobot_wm_command(
            f"train --policy.type={policy_type} --steps=3 --batch_size=4 --dataset.repo_id=a/b {flags}",
            TRAIN_FLAGS.replace("--seed=0", f"--seed={seed}").replace("workers=0", f"workers={workers}"),
            f"--output_dir={tmp_path / str(drawn)}",
        )
        checkpoint = tmp_path / str(drawn) / "checkpoints" / "last"
        weights.append((checkpoint / "pretrained_model" / "model.safetensors").read_bytes())
    once, again, other = weights
    assert once == again
    assert once != other


def test_encoding(inputs: Inputs) -> None:
    policy = load_encoder(str(inputs.world_model))
    source = LeRobotDataset("a/b", root=inputs.dataset)
    latents = []
    for drawn in range(2):
        draw(drawn)
        batches = filter_batches(policy, source, episode_batches(source))
        latents.append(torch.cat(list(batches)))  # (N, L)
    assert torch.equal(*latents)
    assert len(latents[0].unique(dim=0)) == source.num_frames


class Actions:
    """What `lerobot-wm eval` has environments execute, by task and variation."""

    def __init__(self, command: Callable[..., None], monkeypatch: pytest.MonkeyPatch) -> None:
        self._command = command
        self._executed: dict[tuple[str, int], list[np.ndarray]] = {}
        step = MetaworldMTEnv.step

        def noted(env: MetaworldMTEnv, action: np.ndarray) -> Any:
            self._executed.setdefault((env.task, env.variation), []).append(np.array(action))
            return step(env, action)

        monkeypatch.setattr(MetaworldMTEnv, "step", noted)

    def of(self, policy: Path, output: Path, *flags: str) -> tuple[list[Record], dict[Any, np.ndarray]]:
        """An evaluation's records, and the actions (T, 4) of each rollout."""
        self._executed.clear()
        self._command(
            f"eval --policy.path={policy} --policy.device=cpu --policy.use_amp=false --env.type=metaworld_mt",
            f"--seed=0 --output_dir={output}",
            *flags,
        )
        records = sorted(
            read_records([output / "records.jsonl"]), key=lambda record: (record["task"], record["variation"])
        )
        return records, {rollout: np.stack(actions) for rollout, actions in self._executed.items()}


def check_rollouts(run: Actions, policy: Path, tmp_path: Path, sizes: Sequence[int], flags: str) -> None:
    """Compare evaluations at batches of several sizes, the tasks in turn in one order and the other."""
    tasks = ["reach-v3", "window-close-v3"]
    outcomes = []
    for drawn, size in enumerate(sizes):
        draw(drawn)
        tasks.reverse()
        batches = f"--env.task={','.join(tasks)} --eval.batch_size={size}"
        outcomes.append(run.of(policy, tmp_path / str(size), flags, batches))
    (records, actions), *others = outcomes
    assert len({rollout.tobytes() for rollout in actions.values()}) == len(records), "rollouts differ"
    for other_records, other_actions in others:
        assert other_records == records
        assert other_actions.keys() == actions.keys()
        for rollout, executed in actions.items():
            # The sums of a matrix product are ordered by the size of the batch.
            np.testing.assert_allclose(other_actions[rollout], executed, atol=1e-3)


def test_evaluation(
    policy_paths: dict[str, Path],
    tmp_path: Path,
    lerobot_wm_command: Callable[..., None],
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    """With noise on the actions, too: it is a rollout's own."""
    run = Actions(lerobot_wm_command, monkeypatch)
    flags = "--eval.n_episodes=5 --env.episode_length=15 --policy.action_noise=0.3"
    check_rollouts(run, policy_paths["wm_bc"], tmp_path, (1, 5, 2), flags)


@pytest.mark.slow
def test_evaluation_of_all_variations(
    policy_paths: dict[str, Path],
    tmp_path: Path,
    lerobot_wm_command: Callable[..., None],
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    run = Actions(lerobot_wm_command, monkeypatch)
    flags = "--eval.n_episodes=50 --env.episode_length=100"
    check_rollouts(run, policy_paths["wm_bc"], tmp_path, (50, 5, 1), flags)


@pytest.mark.parametrize("variation_set", VARIATION_SETS)
@pytest.mark.parametrize("task", MT6)
def test_fifty_variations_each_once(task: str, variation_set: int) -> None:
    assert len({rand_vec(task, k, variation_set).tobytes() for k in range(50)}) == 50
    env = MetaworldMTEnvConfig(task=task, variation_set=variation_set)
    assert sorted(variation_of(env, seed)[0] for seed in range(7, 57)) == list(range(50))
