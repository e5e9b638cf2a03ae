import hashlib
import json
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest

from lerobot_wm.constants import MT6, MT10, VARIATION_SETS
from lerobot_wm.envs import variations
from lerobot_wm.envs.configuration import MetaworldMTEnvConfig
from lerobot_wm.envs.tasks import all_tasks, expert_name, resolve_tasks, task_description, task_id


def test_task_sets() -> None:
    assert resolve_tasks("mt6") == MT6
    assert resolve_tasks("mt10") == MT10
    assert len(set(resolve_tasks("mt50"))) == 50
    assert {*resolve_tasks("ml45"), *resolve_tasks("ml45_test")} == set(resolve_tasks("mt50"))
    assert resolve_tasks("reach-v3, mt6,reach-v3")[:2] == ("reach-v3", "button-press-topdown-v3")
    assert len(resolve_tasks("reach-v3,mt6")) == 6


@pytest.mark.parametrize(
    ("spec", "hint"),
    [("reach-v2", "reach-v3"), ("mt60", "mt6"), ("drawer-opn-v3", "drawer-open-v3"), (" , ", "mt50")],
)
def test_unknown_task_names_what_exists(spec: str, hint: str) -> None:
    with pytest.raises(ValueError, match=hint):
        resolve_tasks(spec)


def test_held_out_tasks_are_metaworlds() -> None:
    from metaworld.env_dict import ML45_V3

    assert resolve_tasks("ml45_test") == tuple(ML45_V3["test"])
    assert set(resolve_tasks("ml45")) == set(ML45_V3["train"])


def test_names_equal_lerobots() -> None:
    import metaworld
    from lerobot.envs import metaworld as lerobot_metaworld

    assert set(all_tasks()) == set(metaworld.ALL_V3_ENVIRONMENTS)
    for task in all_tasks():
        if task != "push-back-v3":
            assert task_description(task) == lerobot_metaworld.TASK_DESCRIPTIONS[task]
        assert task_id(task) == lerobot_metaworld.TASK_NAME_TO_ID[task]
        assert expert_name(task) == lerobot_metaworld.TASK_POLICY_MAPPING[task].__name__
    assert len({task_description(task) for task in all_tasks()}) == 50


@pytest.mark.parametrize("variation_set", VARIATION_SETS)
def test_variations_are_metaworlds_own(variation_set: int) -> None:
    import pickle

    import metaworld

    tasks = metaworld.MT1("window-close-v3", seed=variation_set).train_tasks
    for k, task in enumerate(tasks):
        ours = variations.rand_vec("window-close-v3", k, variation_set)
        np.testing.assert_array_equal(ours, pickle.loads(task.data)["rand_vec"])


def test_variations_are_complete_and_distinct() -> None:
    """Within a set and between the sets: what settings are chosen on is not what is reported."""
    sets = json.loads(variations.VARIATIONS_PATH.read_bytes())["sets"]
    assert set(sets) == {"42", "43", "44"}
    for task in all_tasks():
        assert len({tuple(vector) for data in sets.values() for vector in data[task]}) == 150
    assert all(data.keys() == set(all_tasks()) for data in sets.values())


def test_reported_variations_never_change() -> None:
    vectors = json.loads(variations.VARIATIONS_PATH.read_bytes())["sets"]["42"]
    digest = hashlib.sha256(json.dumps(vectors).encode()).hexdigest()
    assert digest == "2ac92332ce71a4023cbdeb190a21c37706cc343428dd2bd0c16ad586249fdb2c"


def test_seen_are_the_variations_collected_on() -> None:
    assert [variations.is_seen(k) for k in (0, 9, 10, 49)] == [True, True, False, False]
    assert not any(variations.is_seen(k, 43) for k in range(50))


def test_changed_variations_are_refused(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    changed = tmp_path / "variations.json"
    changed.write_text(variations.VARIATIONS_PATH.read_text().replace("0.1", "0.2", 1))
    monkeypatch.setattr(variations, "VARIATIONS_PATH", changed)
    variations._load.cache_clear()
    with pytest.raises(ValueError, match="SHA-256"):
        variations.rand_vec("reach-v3", 0)
    variations._load.cache_clear()


@pytest.mark.parametrize(
    ("field", "value", "message"),
    [
        ("task", "reach", "reach-v3"),
        ("variation_set", 45, "one of 42, 43, 44"),
        ("camera_name", "corner4", "did you mean corner"),
        ("camera_name", "corner2,", "unknown camera ''"),
        ("camera_name", "corner2, corner2", "each camera once"),
        ("episode_length", 501, "1 to 500"),
        ("image_size", 8, "at least 16"),
        ("obs_type", "state", "pixels_agent_pos"),
    ],
)
def test_config_refuses(field: str, value: object, message: str) -> None:
    with pytest.raises(ValueError, match=message):
        MetaworldMTEnvConfig(**{field: value})


def test_config_imports_no_simulator() -> None:
    code = (
        "import sys, lerobot_wm.envs.configuration as c; c.MetaworldMTEnvConfig(task='mt50');"
        "sys.exit(str([m for m in ('mujoco', 'metaworld') if m in sys.modules] or ''))"
    )
    result = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True)
    assert result.stderr.strip() == ""
