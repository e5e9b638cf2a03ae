"""Training, encoding and evaluation, killed and gone on with as the README says, end as if nothing had happened."""

import random
import shutil
from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest
from safetensors.torch import load_file

from lerobot_wm.envs.tasks import task_description
from lerobot_wm.policies.wm_rssm.modeling_wm_rssm import WMRSSMPolicy
from lerobot_wm.records import read_records
from lerobot_wm.report.training import read_curves
from tests.extended.faults.killing import WatchedCommands, digests
from tests.flags import SMALL_WORLD_MODEL, TRAIN_FLAGS
from tests.recording import camera, record, vector

TASKS = ("reach-v3", "window-close-v3")
EPISODES = 18  # encoded in two batches
# What is written last into a checkpoint of each type: one has no scheduler.
WRITTEN_LAST = {"wm_rssm": "optimizer_param_groups.json", "wm_iql": "scheduler_state.json"}
FINAL = Path("checkpoints") / "000006"
LAST = Path("checkpoints") / "last" / "pretrained_model"
KILLS = [1, pytest.param(20, marks=pytest.mark.slow)]


@pytest.fixture(scope="module")
def dataset(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Noise that a policy for Meta-World can be trained on."""
    features = {
        "observation.image": camera(64, 64),
        **{"observation.state": vector(4), "action": vector(4)},
        **{"next.reward": vector(1), "next.done": vector(1, "bool")},
    }
    episodes = [(task_description(TASKS[i % 2]), 6) for i in range(EPISODES)]
    root = tmp_path_factory.mktemp("kills") / "dataset"
    record(
        root,
        features,
        episodes,
        lambda t, n: {"next.reward": np.float32([t == n - 1]), "next.done": np.array([t == n - 1])},
    )
    return root


class Training:
    """A training of six steps with a checkpoint every three, begun and gone on with in a folder."""

    def __init__(self, commands: WatchedCommands, policy_type: str, flags: str) -> None:
        self._commands, self._type, self._flags = commands, policy_type, flags

    def run(self, folder: Path, kill_at: int | None = None) -> bool:
        """Go on from the last checkpoint, or begin again where none is whole yet; whether it was killed."""
        arguments = f"train --config_path={folder / LAST / 'train_config.json'} --resume=true"
        if not list(folder.glob(f"checkpoints/*/training_state/{WRITTEN_LAST[self._type]}")):
            shutil.rmtree(folder, ignore_errors=True)
            arguments = (
                f"train --policy.type={self._type} {self._flags} --policy.dtype=float32 --steps=6 --save_freq=3 "
                f"--log_freq=1 {TRAIN_FLAGS} --output_dir={folder}"
            )
        return self._commands.run(arguments, folder.parent, kill_at)


def results(run: Path) -> tuple[dict[str, str], dict[str, list[tuple[int, float]]]]:
    """What a finished training leaves: weights, the state of optimizer, schedule and generators, and its curves."""
    assert sorted(path.name for path in (run / "checkpoints").iterdir()) == ["000003", "000006", "last"]
    assert (run / LAST).resolve() == run / FINAL / "pretrained_model"
    weights = digests(run / FINAL / "pretrained_model")["model.safetensors"]
    return {"weights": weights, **digests(run / FINAL / "training_state")}, read_curves(run)


@pytest.fixture(scope="module")
def world_model(
    commands: WatchedCommands, dataset: Path, tmp_path_factory: pytest.TempPathFactory
) -> tuple[Training, Path, list[str]]:
    """A world model's training, the folder of an undisturbed one, and its touches."""
    flags = (
        f"--policy.window_length=4 {SMALL_WORLD_MODEL} --batch_size=2 "
        f"--dataset.repo_id=test/kills --dataset.root={dataset}"
    )
    training = Training(commands, "wm_rssm", flags)
    run = tmp_path_factory.mktemp("wm_rssm") / "run"
    training.run(run)
    return training, run, commands.touches


@pytest.fixture(scope="module")
def encoding(dataset: Path, world_model: tuple[Training, Path, list[str]]) -> str:
    """The command without its output folder."""
    path = world_model[1] / LAST
    flags = f"--dataset.repo_id=test/kills --dataset.root={dataset} --output_repo_id=test/latents"
    return f"encode --world_model_path={path} --device=cpu {flags}"


@pytest.fixture(scope="module")
def latents(
    commands: WatchedCommands, encoding: str, tmp_path_factory: pytest.TempPathFactory
) -> tuple[Path, list[str]]:
    """Latents of an undisturbed encoding, and its touches."""
    root = tmp_path_factory.mktemp("latents") / "latents"
    commands.run(f"{encoding} --output_root={root}", root.parent)
    return root, commands.touches


@pytest.fixture(scope="module")
def policy(
    commands: WatchedCommands,
    world_model: tuple[Training, Path, list[str]],
    latents: tuple[Path, list[str]],
    tmp_path_factory: pytest.TempPathFactory,
) -> tuple[Training, Path, list[str]]:
    """The same of a policy on latents."""
    flags = (
        f"--policy.world_model_path={world_model[1] / LAST} --batch_size=16 "
        f"--dataset.repo_id=test/latents --dataset.root={latents[0]}"
    )
    training = Training(commands, "wm_iql", flags)
    run = tmp_path_factory.mktemp("wm_iql") / "run"
    training.run(run)
    return training, run, commands.touches


def train_with_kills(undisturbed: tuple[Training, Path, list[str]], kills: int, run: Path) -> None:
    """Trainings that are killed `kills` times in all, each until it is finished; compare all that finish."""
    training, expected, touches = undisturbed
    moments = random.Random(0)
    killed = 0
    while True:
        kill_at = moments.randrange(len(touches)) if killed < kills else None
        if training.run(run, kill_at):
            killed += 1
            continue
        assert results(run) == results(expected)
        if kill_at is None:
            return
        shutil.rmtree(run)


@pytest.mark.parametrize("kills", KILLS)
def test_world_model_training(
    world_model: tuple[Training, Path, list[str]], kills: int, tmp_path: Path
) -> None:
    train_with_kills(world_model, kills, tmp_path / "run")


@pytest.mark.slow
def test_policy_training(policy: tuple[Training, Path, list[str]], tmp_path: Path) -> None:
    train_with_kills(policy, 20, tmp_path / "run")


# The second checkpoint: `last` already exists, and between two touches it is not.
MOMENTS = ["os.mkdir training_state", "os.symlink checkpoints/last"]
OTHER_MOMENTS = [
    "os.mkdir 000006",
    "open config.json",
    "open train_config.json",  # the weights are there
    "open policy_preprocessor.json",
    "open policy_postprocessor.json",
    "open training_step.json",
    "open optimizer_param_groups.json",  # as it is opened it is emptied
    "os.remove checkpoints/last",
]


@pytest.mark.parametrize(
    "moment", [*MOMENTS, *(pytest.param(moment, marks=pytest.mark.slow) for moment in OTHER_MOMENTS)]
)
def test_writing_a_checkpoint(
    moment: str,
    world_model: tuple[Training, Path, list[str]],
    tmp_path: Path,
    lerobot_wm_command: Callable[..., None],
) -> None:
    training, expected, touches = world_model
    event, name = moment.split()
    [*_, second] = [
        i for i, touch in enumerate(touches) if touch.startswith(event) and touch.endswith(f"/{name}")
    ]
    run = tmp_path / "run"
    assert training.run(run, second)

    half = run / FINAL
    whole = name == "checkpoints/last"
    first = run / "checkpoints" / "000003"
    if event != "os.symlink":
        assert (run / LAST).resolve() == first / "pretrained_model"
    try:  # never half of the weights
        WMRSSMPolicy.from_pretrained(half / "pretrained_model")
        weights = [folder / FINAL / "pretrained_model" / "model.safetensors" for folder in (run, expected)]
        found, right = map(load_file, weights)
        assert all(bool((found[key] == right[key]).all()) for key in right)
    except (FileNotFoundError, ValueError):
        assert not whole
    if not whole:
        with pytest.raises(FileNotFoundError):
            lerobot_wm_command(
                f"train --config_path={half / 'pretrained_model' / 'train_config.json'} --resume=true"
            )
    half.mkdir(exist_ok=True)
    (half / "half-written").touch()
    training.run(run)
    assert results(run) == results(expected)
    assert event == "os.symlink" or not (half / "half-written").exists()


def test_training_does_not_write_over_checkpoints(
    world_model: tuple[Training, Path, list[str]], tmp_path: Path, lerobot_wm_command: Callable[..., None]
) -> None:
    run = shutil.copytree(world_model[1], tmp_path / "run", symlinks=True)
    before = digests(run)
    config = run / "checkpoints" / "000003" / "pretrained_model" / "train_config.json"
    with pytest.raises(FileExistsError, match=r"000006\).* from step 3"):
        lerobot_wm_command(f"train --config_path={config} --resume=true --output_dir={run}")
    assert digests(run) == before


def test_going_on_from_an_earlier_last_removes_no_checkpoints(
    world_model: tuple[Training, Path, list[str]], tmp_path: Path, lerobot_wm_command: Callable[..., None]
) -> None:
    """The later ones may be wanted, though the link was set back; a kill leaves one of them at most."""
    run = shutil.copytree(world_model[1], tmp_path / "run", symlinks=True)
    last = run / "checkpoints" / "last"
    last.unlink()
    last.symlink_to("000003")
    shutil.copytree(run / "checkpoints" / "000006", run / "checkpoints" / "000009")
    before = digests(run)
    config = last / "pretrained_model" / "train_config.json"
    with pytest.raises(FileExistsError, match=r"000006, 000009\).* from step 3"):
        lerobot_wm_command(f"train --config_path={config} --resume=true --output_dir={run}")
    assert digests(run) == before


def test_a_training_without_a_checkpoint_begins_again(
    tmp_path: Path, lerobot_wm_command: Callable[..., None]
) -> None:
    with pytest.raises(FileNotFoundError, match=r"train_config.json"):
        lerobot_wm_command(f"train --config_path={tmp_path / LAST / 'train_config.json'} --resume=true")


@pytest.mark.parametrize("kills", KILLS)
def test_encoding(
    kills: int, commands: WatchedCommands, encoding: str, latents: tuple[Path, list[str]], tmp_path: Path
) -> None:
    expected, touches = latents
    root = tmp_path / "latents"
    moments = random.Random(1)
    killed = 0
    while killed < kills:
        while not root.exists():
            kill_at = moments.randrange(len(touches)) if killed < kills else None
            killed += commands.run(f"{encoding} --output_root={root}", tmp_path, kill_at)
        assert digests(root) == digests(expected)
        shutil.rmtree(root)
    assert killed == kills


def test_encoding_killed_at_its_very_end(
    commands: WatchedCommands,
    encoding: str,
    latents: tuple[Path, list[str]],
    tmp_path: Path,
    lerobot_wm_command: Callable[..., None],
) -> None:
    expected, touches = latents
    command = f"{encoding} --output_root={tmp_path / 'latents'}"
    assert commands.run(command, tmp_path, touches.index("shutil.rmtree latents.parts"))
    assert (tmp_path / "latents.parts").exists()
    assert digests(tmp_path / "latents") == digests(expected)
    with pytest.raises(FileExistsError, match="already exists"):
        lerobot_wm_command(command)
    assert [path.name for path in tmp_path.iterdir()] == ["latents"]


@pytest.mark.parametrize("all_moments", [False, pytest.param(True, marks=pytest.mark.slow)])
def test_evaluation(
    all_moments: bool, commands: WatchedCommands, policy: tuple[Training, Path, list[str]], tmp_path: Path
) -> None:
    def command(folder: Path) -> str:
        return (
            f"eval --policy.path={policy[1] / LAST} --policy.device=cpu --env.type=metaworld_mt --seed=0 "
            f"--env.task={','.join(TASKS)} --env.episode_length=4 --eval.n_episodes=2 --output_dir={folder}"
        )

    commands.run(command(tmp_path / "undisturbed"), tmp_path)
    expected = read_records([tmp_path / "undisturbed" / "records.jsonl"])
    assert len(expected) == 4
    done = commands.touches.index("os.rename undisturbed/records.jsonl")
    for kill_at in range(len(commands.touches)) if all_moments else [done, done + 1]:
        folder = tmp_path / f"killed-{kill_at}"
        assert commands.run(command(folder), tmp_path, kill_at)
        if not (folder / "records.jsonl").exists():
            commands.run(command(folder), tmp_path)
        assert read_records([folder / "records.jsonl"]) == expected
        names = {path.name for path in folder.iterdir()}
        assert names - {".records.jsonl.lock"} == {"eval_info.json", "records.jsonl", "videos"}
