"""`lerobot-wm expert`: the scripted expert's rollouts as records, equal to those in the environment."""

from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest
from metaworld.policies import SawyerDoorOpenV3Policy

from lerobot_wm.envs.metaworld_mt import MetaworldMTEnv
from lerobot_wm.records import Record, read_records


@pytest.fixture(scope="module")
def records(
    tmp_path_factory: pytest.TempPathFactory, lerobot_wm_command: Callable[..., None]
) -> list[Record]:
    folder = tmp_path_factory.mktemp("expert")
    flags = "--tasks=reach-v3,door-open-v3 --variations=8-10 --preset=tiny"
    lerobot_wm_command(f"expert {flags} --output_dir={folder}")
    return read_records([folder / "records.jsonl"])


def test_one_record_per_variation(records: list[Record]) -> None:
    assert [(r["task"], r["variation"], r["seen"]) for r in records] == [
        (task, k, k < 10) for task in ("reach-v3", "door-open-v3") for k in (8, 9, 10)
    ]
    for record in records:
        assert (record["arm"], record["policy_type"], record["preset"]) == ("expert", "scripted", "tiny")
        assert record["seed"] == 0
        assert record["return"] == float(record["success"])
        assert record["success"] == (record["steps"] < 500)
    # The expert fails door-open-v3's variation 9 and no other of these.
    assert [r["variation"] for r in records if not r["success"]] == [9]


def test_steps_are_those_until_the_environment_ends_the_episode(records: list[Record]) -> None:
    env = MetaworldMTEnv("door-open-v3")
    env.reset(seed=8)
    expert = SawyerDoorOpenV3Policy()
    steps, terminated = 0, False
    while not terminated:
        action = np.clip(expert.get_action(env.environment_state), -1, 1)
        *_, terminated, _, _ = env.step(action)
        steps += 1
    env.close()
    [record] = [r for r in records if (r["task"], r["variation"]) == ("door-open-v3", 8)]
    assert record["steps"] == steps


def test_the_second_set_has_its_own_rollouts(
    records: list[Record], tmp_path: Path, lerobot_wm_command: Callable[..., None]
) -> None:
    flags = "--tasks=reach-v3 --variations=8-10 --variation_set=43 --num_workers=1"
    lerobot_wm_command(f"expert {flags} --output_dir={tmp_path}")
    second = read_records([tmp_path / "records.jsonl"])
    assert not any(record["seen"] for record in second)
    assert [r["steps"] for r in second] != [r["steps"] for r in records[:3]]


def test_rollouts_end_where_the_environments_do(
    records: list[Record], tmp_path: Path, lerobot_wm_command: Callable[..., None]
) -> None:
    longest = max(records[:3], key=lambda record: record["steps"])
    assert longest["success"]
    for length in (longest["steps"], longest["steps"] - 1):
        flags = f"--tasks=reach-v3 --variations=8-10 --episode_length={length} --num_workers=1"
        lerobot_wm_command(f"expert {flags} --output_dir={tmp_path / str(length)}")
        for record, whole in zip(
            read_records([tmp_path / str(length) / "records.jsonl"]), records[:3], strict=True
        ):
            success = whole["steps"] <= length
            assert (record["success"], record["return"]) == (success, float(success))
            assert record["steps"] == min(whole["steps"], length)


@pytest.mark.parametrize(
    ("flags", "message"),
    [
        ("--tasks=reach", "did you mean reach-v3"),
        ("--variation_set=45", "one of 42, 43, 44"),
        ("--variations=50", "0 to 49"),
    ],
)
def test_bad_flags(flags: str, message: str, tmp_path: Path, lerobot_wm_command: Callable[..., None]) -> None:
    with pytest.raises(ValueError, match=message):
        lerobot_wm_command(f"expert {flags} --output_dir={tmp_path}")


def test_earlier_records_are_never_overwritten(
    tmp_path: Path, lerobot_wm_command: Callable[..., None]
) -> None:
    (tmp_path / "records.jsonl").write_text("")
    with pytest.raises(FileExistsError, match=r"records\.jsonl"):
        lerobot_wm_command(f"expert --output_dir={tmp_path}")
