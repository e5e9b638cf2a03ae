"""Each thing that is published, pulled again by its name on a machine that has nothing."""

import io
import json
import re
from pathlib import Path

import numpy as np
import pytest
from huggingface_hub import DatasetCard, ModelCard
from lerobot.policies.factory import get_policy_class
from PIL import Image
from safetensors.torch import load

from lerobot_wm.data.latents import LatentRecord, dataset_fingerprint, weights_fingerprint
from tests.extended.hub.conftest import TRAIN, Machine, read
from tests.extended.hub.server import Hub
from tests.flags import SMALL_WORLD_MODEL

PYTHON_BLOCK = re.compile(r"```python\n(.*?)```", re.DOTALL)
PULL = """
from pathlib import Path
from lerobot.datasets.lerobot_dataset import LeRobotDataset
from lerobot_wm.data.latents import dataset_fingerprint
dataset = LeRobotDataset({repo_id!r}, revision={revision!r})
print("fingerprint", dataset_fingerprint(Path(dataset.root)), sorted(dataset[0]))
"""


def pulled(machine: Machine, repo_id: str, revision: str | None = None) -> list[str]:
    """Fingerprint and keys of a dataset that a machine without anything gets."""
    result = machine.python(PULL.format(repo_id=repo_id, revision=revision), empty_home=True)
    assert result.status == 0, result.output
    return result.lines[-1].split(maxsplit=2)[1:]


def test_demonstrations_arrive_to_the_byte(
    hub: Hub, machine: Machine, demos_commit: str, demos_root: Path
) -> None:
    fingerprint, keys = pulled(machine, "user/demos")
    assert fingerprint == dataset_fingerprint(demos_root)
    assert "observation.image" in keys
    card = DatasetCard(read(hub, "dataset", "user/demos", "README.md").decode())
    assert card.data.license == "apache-2.0"
    assert {"LeRobot", "lerobot_wm", "metaworld"} <= set(card.data.tags)
    assert re.search(r"\| reach-v3 \| Reach a goal position \| 4 \| [\d.]+ \| 0-3 \| \d+ \| 0 \|", card.text)
    assert "lerobot-wm collect --tasks=reach-v3,window-close-v3 --episodes_per_task=4" in card.text
    assert fingerprint in card.text


def test_a_revision_stays_what_it_was(hub: Hub, machine: Machine, demos_commit: str) -> None:
    before = pulled(machine, "user/demos", demos_commit)
    repo = hub.repos["dataset", "user/demos"]
    files = dict(repo.files())
    info = json.loads(hub.content(files["meta/info.json"])) | {"robot_type": "another"}
    later = hub.commit(repo, "main", files | {"meta/info.json": hub.store(json.dumps(info).encode())})
    assert pulled(machine, "user/demos", later) != before
    assert pulled(machine, "user/demos", demos_commit) == before


def test_latents_are_made_from_the_hub_and_arrive_to_the_byte(
    hub: Hub, machine: Machine, demos_commit: str, world_model_commit: str, demos_root: Path, tmp_path: Path
) -> None:
    encode = (
        f"encode --world_model_path=user/wm@{world_model_commit} --device=cpu --push_to_hub=true --private=true "
        f"--dataset.repo_id=user/demos --dataset.revision={demos_commit} --output_repo_id=user/latents "
        f"--output_root={tmp_path / 'latents'}"
    )
    hub.hang_ups.append("POST .*/user/latents/commit/")
    result = machine.run(encode, empty_home=True)
    assert result.status == 1
    assert "lost the connection" in result.lines[-1]
    result = machine.run(encode)  # encodes nothing again, and sends no large file twice
    assert result.status == 0, result.output
    assert "Encoding" not in result.output
    assert hub.repos["dataset", "user/latents"].private

    code = PULL.format(repo_id="user/latents", revision=None)
    result = machine.python(code, token="read-user", empty_home=True)
    assert result.lines[-1].split()[1] == dataset_fingerprint(tmp_path / "latents")
    record = LatentRecord.read(tmp_path / "latents")
    assert record.source_fingerprint == dataset_fingerprint(demos_root)
    card = DatasetCard(read(hub, "dataset", "user/latents", "README.md").decode())
    assert card.data.license == "apache-2.0"  # of the source's card
    for fact in (
        "frozen world model",
        f"user/wm@{world_model_commit}",
        record.world_model_fingerprint,
        record.source_fingerprint,
    ):
        assert fact in card.text


@pytest.mark.parametrize("repo_id", ["user/wm", "user/wm_iql"])
def test_a_trained_policy_arrives_to_the_byte_and_its_card_works(
    repo_id: str, hub: Hub, machine: Machine, checkpoints: dict[str, Path]
) -> None:
    checkpoint = checkpoints[repo_id]
    for name in ("model.safetensors", "config.json", "policy_preprocessor.json"):
        assert read(hub, "model", repo_id, name) == (checkpoint / name).read_bytes()
    card = ModelCard(read(hub, "model", repo_id, "README.md").decode())
    assert card.data.datasets == ["user/demos"]
    assert "| frames a second, robot | 80, `metaworld` |" in card.text
    [example] = PYTHON_BLOCK.findall(card.text)
    made = "states.latent" if repo_id == "user/wm" else "action"
    result = machine.python(
        f"{example}\nprint(tuple({made}.shape), {made}.isfinite().all().item())", empty_home=True
    )
    assert result.status == 0, result.output
    assert result.lines[-1] == ("(1, 5, 24) True" if repo_id == "user/wm" else "(1, 4) True")


@pytest.fixture(scope="module")
def published(machine: Machine, checkpoints: dict[str, Path], demos_commit: str, runs: Path) -> None:
    """The world model trained again, stopped and resumed, a policy on a folder's latents, and one trained on."""
    train = (
        f"train --policy.type=wm_rssm {SMALL_WORLD_MODEL} {TRAIN} --policy.repo_id=user/resumed --save_freq=1"
    )
    resumed, latents = runs / "resumed", runs / "latents"
    last = resumed / "checkpoints" / "last" / "pretrained_model" / "train_config.json"
    for command in (
        f"{train} --steps=1 --dataset.repo_id=user/demos --dataset.revision={demos_commit} --output_dir={resumed}",
        f"train --config_path={last} --resume=true --steps=2",
        f"encode --world_model_path={checkpoints['user/wm']} --device=cpu --dataset.repo_id=user/demos "
        f"--output_repo_id=user/of_a_folder --output_root={latents}",
        f"train --policy.type=wm_bc --policy.world_model_path={checkpoints['user/wm']} {TRAIN} "
        f"--policy.repo_id=user/wm_bc --dataset.repo_id=user/of_a_folder --dataset.root={latents} "
        f"--output_dir={runs / 'wm_bc'}",
        f"train --policy.path=user/wm_iql {TRAIN} --policy.repo_id=user/tuned --dataset.repo_id=user/demos "
        f"--output_dir={runs / 'tuned'}",
    ):
        result = machine.run(command)
        assert result.status == 0, result.output


@pytest.mark.parametrize("repo_id", ["user/wm", "user/resumed", "user/wm_iql", "user/wm_bc", "user/tuned"])
def test_the_command_on_a_card_trains_the_same_weights(
    repo_id: str, hub: Hub, machine: Machine, published: None, runs: Path, tmp_path: Path
) -> None:
    card = ModelCard(read(hub, "model", repo_id, "README.md").decode())
    assert str(runs) not in card.text
    [command] = re.findall(r"lerobot-wm (train --config_path=.*)", card.text)
    again = tmp_path / "again"
    result = machine.run(command.replace("outputs/again", str(again)), token="read-user", empty_home=True)
    assert result.status == 0, result.output
    weights = again / "checkpoints/last/pretrained_model/model.safetensors"
    assert weights.read_bytes() == read(hub, "model", repo_id, "model.safetensors")


def test_a_policy_holds_the_pinned_world_model(hub: Hub, checkpoints: dict[str, Path]) -> None:
    ours = load(read(hub, "model", "user/wm_iql", "model.safetensors"))
    frozen = load(read(hub, "model", "user/wm", "model.safetensors"))
    assert all((ours[name] == tensor).all() for name, tensor in frozen.items())
    world_model = get_policy_class("wm_rssm").from_pretrained(checkpoints["user/wm"]).world_model
    card = read(hub, "model", "user/wm_iql", "README.md").decode()
    assert weights_fingerprint(world_model) in card


def test_eval_takes_a_policy_by_its_name_and_publish_adds_the_results(
    hub: Hub, machine: Machine, checkpoints: dict[str, Path], demos_root: Path, tmp_path: Path
) -> None:
    result = machine.run(
        "eval --policy.path=user/wm_iql --policy.device=cpu --env.type=metaworld_mt --env.task=reach-v3",
        f"--env.episode_length=3 --eval.n_episodes=2 --eval.batch_size=2 --seed=9 --output_dir={tmp_path}",
        empty_home=True,
    )
    assert result.status == 0, result.output
    hub.requests.clear()
    result = machine.run(
        f"publish --policy.path={checkpoints['user/wm_iql']} --repo_id=user/wm_iql --records={tmp_path}/records.jsonl",
        f"--dataset.repo_id=user/demos --dataset.root={demos_root}",
    )
    assert result.status == 0, result.output
    assert len([request for request in hub.requests if "/commit/" in request]) == 1  # nobody sees half of it
    assert (
        len([request for request in hub.requests if request.startswith("PUT")]) == 1
    )  # the picture alone is new
    card = ModelCard(read(hub, "model", "user/wm_iql", "README.md").decode())
    assert "| reach-v3 | 0/1  0 [0, 79] | 0/1  0 [0, 79] | 0/2  0 [0, 66] |" in card.text
    assert re.search(r"\| Reach a goal position \| [\d.]+ \([\d.]+\) \|", card.text)
    assert "![Truth above, imagination below](imagination.webp)" in card.text
    picture = Image.open(io.BytesIO(read(hub, "model", "user/wm_iql", "imagination.webp")))
    assert (picture.n_frames, picture.size) == (50, (256, 258))
    first, last = (np.asarray((picture.seek(k), picture.convert("RGB"))[1]).astype(float) for k in (0, 49))
    errors = [abs(frame[:128] - frame[130:]).mean() for frame in (first, last)]
    assert errors[0] < 5 < errors[1]  # what it saw, what it imagined


def test_interrupted_upload_of_a_checkpoint_shows_nothing_and_is_whole_the_second_time(
    hub: Hub, machine: Machine, checkpoints: dict[str, Path]
) -> None:
    publish = f"publish --policy.path={checkpoints['user/wm_iql']} --repo_id=user/again"
    # The client tries again by itself where a large file breaks off, but not where the commit does.
    hub.hang_ups += ["PUT /large-files/", "POST .*/user/again/commit/"]
    weights = hub.folder / hub.repos["model", "user/wm_iql"].files()["model.safetensors"].sha256
    content = weights.read_bytes()
    weights.unlink()  # as if it had never been uploaded
    result = machine.run(publish)
    assert result.status == 1
    assert "Traceback" not in result.output
    assert "lost the connection" in result.lines[-1]
    assert not hub.hang_ups
    assert list(hub.repos["model", "user/again"].files()) == [".gitattributes"]
    assert machine.run(publish).status == 0
    assert read(hub, "model", "user/again", "model.safetensors") == content
    assert {"config.json", "README.md", "policy_preprocessor.json"} <= set(
        hub.repos["model", "user/again"].files()
    )


def test_interrupted_upload_of_a_dataset_leaves_readers_the_version_before(
    hub: Hub, machine: Machine, demos_commit: str, collect: str
) -> None:
    repo = hub.repos["dataset", "user/demos"]
    repo.branches["main"] = demos_commit
    hub.hang_ups.append("POST .*/user/demos/commit/")
    result = machine.run(f"{collect} --license=mit")
    assert result.status == 1
    assert "lost the connection" in result.lines[-1]
    assert repo.tags["v3.0"] == demos_commit
    assert machine.run(f"{collect} --license=mit").status == 0
    assert DatasetCard(hub.content(repo.files("v3.0")["README.md"]).decode()).data.license == "mit"
