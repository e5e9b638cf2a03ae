"""A failed download or upload ends in one line that says what was found and how to fix it."""

from pathlib import Path

import pytest

from tests.extended.hub.conftest import Machine
from tests.extended.hub.server import Hub, Repo

TRAIN = "train --policy.type=wm_rssm --policy.device=cpu --steps=1 --num_workers=0 --output_dir={folder}/run"
ENCODE = (
    "encode --output_repo_id=user/x --output_root={folder}/x --dataset.repo_id=user/demos --world_model_path="
)
GO_ON = "train --policy.path=user/wm --policy.device=cpu --steps=1 --num_workers=0 --output_dir={folder}/run"
EVAL = "eval --env.type=metaworld_mt --env.task=reach-v3 --eval.n_episodes=1 --output_dir={folder}/eval --policy.path="


@pytest.fixture(scope="module")
def odd_repositories(hub: Hub) -> None:
    """A dataset whose upload was interrupted before its version was tagged, one of LeRobot 2, and a private model."""
    repo = hub.repos["dataset", "user/half"] = Repo(private=False)
    hub.commit(repo, "main", {"data/chunk-000/file-000.parquet": hub.store(b"")})
    old = hub.repos["dataset", "user/old"] = Repo(private=False)
    old.tags["v2.1"] = hub.commit(old, "main", {"meta/info.json": hub.store(b"{}")})
    hub.repos["model", "user/secret"] = Repo(private=True)


@pytest.mark.usefixtures("world_model_commit", "odd_repositories")
@pytest.mark.parametrize(
    ("command", "token", "said"),
    [
        # What is asked for is not there.
        (
            f"{TRAIN} --policy.push_to_hub=false --dataset.repo_id=user/nothing",
            "",
            "/api/datasets/user/nothing",
        ),
        (f"{ENCODE}user/wm --dataset.revision=v9", "write-user", "it has the versions v3.0"),
        (f"{ENCODE}user/wm --dataset.revision=nope", "write-user", "Revision Not Found"),
        (f"{ENCODE}user/wm --dataset.repo_id=user/half", "write-user", "its upload did not finish"),
        (
            f"{ENCODE}user/wm --dataset.repo_id=user/old",
            "write-user",
            "lerobot-wm repair --dataset.repo_id=user/old",
        ),
        (f"{ENCODE}user/wm@v9", "write-user", "Revision Not Found"),
        (f"{ENCODE}outputs/no/such/folder", "write-user", "neither a folder on this machine nor"),
        (
            "report --records={folder}/records.jsonl --dataset.repo_id=user/demos --dataset.revision=v9",
            "write-user",
            "it has the versions v3.0",
        ),
        (
            "quality --world_model_path=user/wm --output_dir={folder}/x --dataset.repo_id=user/demos "
            "--dataset.revision=v9",
            "write-user",
            "it has the versions v3.0",
        ),
        (f"{EVAL}user/nothing", "", "user/nothing"),
        ("publish --policy.path={folder} --repo_id=user/x", "write-user", "holds no train_config.json"),
        # The token does not do.
        (f"{ENCODE}user/wm", "wrong-token", "Invalid credentials"),
        (f"{ENCODE}user/secret", "", "private or gated"),
        (
            f"{TRAIN} --dataset.repo_id=user/demos --policy.repo_id=user/x",
            "",
            "asks for a token and there is none",
        ),
        ("collect --repo_id=else/x --root={folder}/x --push_to_hub=true", "write-user", "belongs to else"),
        (f"{ENCODE}user/wm --push_to_hub=true", "read-user", "is read-only"),
        ("publish --policy.path={folder} --repo_id=user/x", "", "asks for a token and there is none"),
        # What is there would be lost.
        (
            f"{GO_ON} --dataset.repo_id=user/demos",
            "write-user",
            "user/wm is where the policy of --policy.path is published",
        ),
    ],
)
def test_one_line(command: str, token: str, said: str, machine: Machine, tmp_path: Path) -> None:
    command = command.format(folder=tmp_path)
    result = machine.run(command, token=token, empty_home=True)
    assert result.status == 1
    assert "Traceback" not in result.output
    assert result.lines[-1].startswith(f"lerobot-wm {command.split()[0]}: ")
    assert said in result.lines[-1]
    assert not (tmp_path / "run" / "checkpoints").exists()
