"""A dataset by its Hub name alone lies where LeRobot downloads it to; there it is checked, and named on cards."""

from pathlib import Path

import pytest
from huggingface_hub import ModelCard

from lerobot_wm.data.latents import dataset_fingerprint
from tests.extended.hub.conftest import TRAIN, Machine, read
from tests.extended.hub.server import Hub


@pytest.fixture
def version(hub: Hub, demos_commit: str) -> str:
    """The commit of the dataset's version; other tests publish it again."""
    return hub.repos["dataset", "user/demos"].tags["v3.0"]


BEGIN = """
import shutil
from pathlib import Path
from lerobot.datasets.dataset_metadata import LeRobotDatasetMetadata
from lerobot.datasets.lerobot_dataset import LeRobotDataset
from lerobot.utils.constants import HF_LEROBOT_HOME
from lerobot_wm.data.source import dataset_folder, open_dataset
name = "user/demos"
"""


def run(machine: Machine, code: str) -> None:
    """Run a program that begins as `BEGIN`, on a machine without anything."""
    result = machine.python(BEGIN + code, empty_home=True)
    assert result.status == 0, result.output


def test_the_folder_is_the_one_that_lerobot_reads(machine: Machine, version: str) -> None:
    code = """
assert dataset_folder(name) is None
for revision in (None, "v3.0", "3.0", {commit!r}, "main"):
    assert LeRobotDatasetMetadata(name, revision=revision).root == dataset_folder(name, revision=revision)
snapshot = dataset_folder(name)
assert snapshot.name == {commit!r}
assert dataset_folder(name, whole=True) is None  # LeRobot has asked for the metadata alone
LeRobotDataset(name)
assert dataset_folder(name, whole=True) == snapshot
# A download as LeRobot made them before; it reads the snapshot all the same.
folder = shutil.copytree(snapshot, HF_LEROBOT_HOME / name)
(folder / ".cache/huggingface/download").mkdir(parents=True)
assert dataset_folder(name) == LeRobotDatasetMetadata(name).root == snapshot
# Recorded here: used for any revision.
shutil.rmtree(folder / ".cache")
for revision in (None, {commit!r}):
    assert dataset_folder(name, revision=revision) == LeRobotDatasetMetadata(name, revision=revision).root == folder
assert dataset_folder(name, snapshot) == snapshot
assert dataset_folder(name, HF_LEROBOT_HOME / "nothing") is None
"""
    run(machine, code.format(commit=version))


@pytest.mark.usefixtures("demos_commit")
def test_a_download_of_some_episodes_passes(machine: Machine) -> None:
    run(
        machine,
        """
dataset = LeRobotDataset(name, episodes=[0])
(dataset.root / "README.md").unlink(missing_ok=True)
open_dataset(name)
shutil.rmtree(dataset.root / "videos")
next((dataset.root / "data").rglob("*.parquet")).resolve().unlink()  # leaves a link to nothing
open_dataset(name)
(dataset.root / "meta/tasks.parquet").unlink()  # broken off before that
open_dataset(name)
assert len(LeRobotDataset(name)) and dataset_folder(name, whole=True) == dataset.root
""",
    )


@pytest.mark.parametrize(
    ("part", "said"),
    [("data", "cannot be read"), ("meta/episodes", "cannot be read"), ("videos", "lacks its last 100 bytes")],
)
def test_a_damaged_file_is_named_and_how_to_get_it_again(
    part: str, said: str, machine: Machine, world_model_commit: str, tmp_path: Path
) -> None:
    code = """
root = LeRobotDataset(name).root
file = next(path for path in sorted((root / {part!r}).rglob("*")) if path.is_file()).resolve()
file.write_bytes(file.read_bytes()[:-100])
"""
    run(machine, code.format(part=part))
    result = machine.run(
        f"encode --world_model_path=user/wm@{world_model_commit} --device=cpu --dataset.repo_id=user/demos",
        f"--output_repo_id=user/x --output_root={tmp_path / 'x'}",
    )
    assert result.status == 1
    assert "Traceback" not in result.output
    assert f"/{part}" in result.lines[-1]
    assert said in result.lines[-1]
    _, _, fix = result.lines[-1].partition("remove ")
    assert fix.startswith(str(machine.folder / "home/lerobot/hub/datasets--user--demos"))
    assert not (tmp_path / "x").exists()


def test_what_is_made_of_it_outlives_a_prune(
    machine: Machine, version: str, world_model_commit: str, tmp_path: Path
) -> None:
    training = f"--policy.type=wm_bc --policy.world_model_path=user/wm@{world_model_commit}"
    code = """
import os, sys
from huggingface_hub import scan_cache_dir
from lerobot.utils.constants import HF_LEROBOT_HUB_CACHE
from lerobot_wm import cli
del os.environ["LEROBOT_WM_CACHE"]
sys.argv = ["lerobot-wm", *{arguments!r}.split()]
cli.main()
[repository] = scan_cache_dir(HF_LEROBOT_HUB_CACHE).repos
[revision] = repository.revisions
assert revision.commit_hash == {commit!r} and revision.refs
assert not list(revision.snapshot_path.rglob(".cache"))  # nothing was downloaded past the cache
[cache] = (HF_LEROBOT_HOME / "lerobot_wm").iterdir()
assert cache.name == "user--demos--{commit}.cache"
assert {{path.name.split("-")[0] for path in cache.iterdir() if path.is_dir()}} == {{"frames", "latents"}}
"""
    arguments = (
        f"train {training} {TRAIN.replace('push_to_hub=true', 'push_to_hub=false')} "
        f"--dataset.repo_id=user/demos --output_dir={tmp_path / 'run'}"
    )
    run(machine, code.format(arguments=arguments, commit=version))


def test_publish_names_the_dataset_and_its_fingerprint(
    hub: Hub, machine: Machine, demos_commit: str, checkpoints: dict[str, Path], demos_root: Path
) -> None:
    publish = f"publish --policy.path={checkpoints['user/wm']} --repo_id=user/named"
    assert machine.run(publish, empty_home=True).status == 0
    assert not ModelCard(read(hub, "model", "user/named", "README.md").decode()).data.datasets
    result = machine.python(f"{BEGIN}LeRobotDataset(name, revision={demos_commit!r})", empty_home=True)
    assert result.status == 0, result.output
    assert machine.run(publish).status == 0
    card = ModelCard(read(hub, "model", "user/named", "README.md").decode())
    assert card.data.datasets == ["user/demos"]
    assert dataset_fingerprint(demos_root) in card.text
