"""Metadata and configurations of any content: accepted, or refused by a documented error in one line."""

import json
import tempfile
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import pyarrow as pa
import pyarrow.parquet as pq
import pytest
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st
from lerobot.configs import PreTrainedConfig
from lerobot.configs.default import DatasetConfig
from lerobot.configs.train import TrainPipelineConfig
from lerobot.datasets.dataset_metadata import LeRobotDatasetMetadata

from lerobot_wm.data.source import DatasetError, open_dataset
from lerobot_wm.errors import exit_with_one_line
from lerobot_wm.policies.wm_bc.configuration_wm_bc import WMBCConfig
from lerobot_wm.policies.wm_rssm.configuration_wm_rssm import WMRSSMConfig
from tests.extended.faults.breakage import EPISODES, INFO, STATS, TASKS
from tests.recording import record, vector

SETTINGS: dict[str, Any] = {
    "deadline": None,
    "database": None,
    "derandomize": True,
    "suppress_health_check": [
        HealthCheck.function_scoped_fixture,
        HealthCheck.too_slow,
        HealthCheck.data_too_large,
    ],
}
FEW = settings(max_examples=30, **SETTINGS)
MANY = settings(max_examples=2000, **SETTINGS)  # 8,000 of metadata and 2,200 of configurations

VALUES = st.recursive(
    st.none()
    | st.booleans()
    | st.integers()
    | st.integers(-2, 40)
    | st.floats()
    | st.text(max_size=20)
    | st.sampled_from(
        ["", "..", "../../x", "float32", "video", "v3.0", "\x00", "x" * 300, "{chunk_index:99999d}", "{0}"]
    ),
    lambda inner: st.lists(inner, max_size=3) | st.dictionaries(st.text(max_size=8), inner, max_size=3),
    max_leaves=4,
)


def places(value: Any, path: tuple = ()) -> Iterator[tuple]:
    """The path of every entry of a JSON value."""
    yield path
    if isinstance(value, dict | list):
        for key, inner in value.items() if isinstance(value, dict) else enumerate(value):
            yield from places(inner, (*path, key))


def changed(draw: Callable[..., Any], text: str) -> str:
    """A JSON text with one to three entries replaced, removed or added, or with its letters changed."""
    if draw(st.integers(0, 9)) == 0:
        cut = draw(st.integers(0, len(text)))
        return text[:cut] + draw(st.text(max_size=5)) + text[cut + draw(st.integers(0, 20)) :]
    content = json.loads(text)
    for _ in range(draw(st.integers(1, 3))):
        path = draw(st.sampled_from(list(places(content))))
        if not path:
            content = draw(VALUES)
            continue
        parent = content
        for key in path[:-1]:
            parent = parent[key]
        match draw(st.sampled_from(["replace", "replace", "remove", "add"])):
            case "replace":
                parent[path[-1]] = draw(VALUES)
            case "remove":
                del parent[path[-1]]
            case "add" if isinstance(parent, dict):
                parent[draw(st.text(max_size=8))] = draw(VALUES)
    return json.dumps(content)


def write_json(draw: Callable[..., Any], path: Path, text: str) -> None:
    path.write_bytes(changed(draw, text).encode("utf-8", "surrogatepass"))


def write_table(draw: Callable[..., Any], path: Path, original: bytes) -> None:
    """A parquet file with a column's values or type changed, or removed or there twice, or with its bytes changed."""
    kind = draw(st.sampled_from(["bytes", "values", "type", "remove", "twice", "rows"]))
    if kind == "bytes":
        start = draw(st.integers(0, len(original)))
        path.write_bytes(
            original[:start] + draw(st.binary(max_size=8)) + original[start + draw(st.integers(0, 64)) :]
        )
        return
    table = pq.read_table(pa.BufferReader(original))
    place = draw(st.integers(0, table.num_columns - 1))
    field = table.schema.field(place)
    if kind == "values":
        values = draw(st.lists(st.integers(-1, 2**63 - 1), min_size=len(table), max_size=len(table)))
        table = table.set_column(place, field.name, pa.array(values))
    elif kind == "type":
        values = draw(st.sampled_from([None, "x", [1], {"a": 1}, 0.5, True, float("nan")]))
        table = table.set_column(place, field.name, pa.array([values] * len(table)))
    elif kind == "remove":
        table = table.remove_column(place)
    elif kind == "twice":
        table = table.append_column(field.name, table.column(place))
    else:
        table = table.take(pa.array(draw(st.lists(st.integers(0, len(table) - 1), max_size=5)), pa.int64()))
    pq.write_table(table, path)


@pytest.fixture(scope="module")
def numbers_dataset(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A dataset without cameras: quick to check."""
    root = tmp_path_factory.mktemp("numbers") / "dataset"
    features = {"observation.state": vector(2), "action": vector(2), "next.reward": vector(1)}
    record(root, features, [("Lift", 4), ("Push", 3), ("Lift", 5)])
    return root


def check_metadata(draw: Callable[..., Any], name: str, root: Path) -> None:
    """Change a file and check the dataset: what passes, LeRobot reads."""
    path = root / name
    original = path.read_bytes()
    try:
        if path.suffix == ".json":
            write_json(draw, path, original.decode())
        else:
            write_table(draw, path, original)
        message = ""
        try:
            open_dataset("test/recorded", root)
        except DatasetError as error:
            message = str(error)
        assert message.isprintable()
        assert len(message) < len(str(root)) + 700
        if not message:
            assert LeRobotDatasetMetadata("test/recorded", root=root).total_frames == 12
    finally:
        path.write_bytes(original)


METADATA = pytest.mark.parametrize("name", [INFO, STATS, EPISODES, TASKS])


@METADATA
@FEW
@given(data=st.data())
def test_metadata(data: st.DataObject, name: str, numbers_dataset: Path) -> None:
    check_metadata(data.draw, name, numbers_dataset)


@pytest.mark.slow
@METADATA
@MANY
@given(data=st.data())
def test_metadata_at_length(data: st.DataObject, name: str, numbers_dataset: Path) -> None:
    check_metadata(data.draw, name, numbers_dataset)


def configuration(kind: str) -> str:
    """A configuration file's text: of a policy, or of a training of one."""
    policy = {"wm_bc": WMBCConfig, "wm_rssm": WMRSSMConfig}[kind.split("/")[0]](
        device="cpu", push_to_hub=False
    )
    config = TrainPipelineConfig(DatasetConfig("test/x"), policy=policy) if "/" in kind else policy
    with tempfile.TemporaryDirectory() as folder:
        config.save_pretrained(folder)
        [path] = Path(folder).iterdir()
        return path.read_text()


def check_configuration(draw: Callable[..., Any], kind: str, folder: Path) -> None:
    """Change a configuration and load it as the commands do: it is taken, or they end with one line."""
    config_type, name = (
        (TrainPipelineConfig, "train_config.json") if "/" in kind else (PreTrainedConfig, "config.json")
    )
    write_json(draw, folder / name, TEXTS[kind])
    line = "lerobot-wm: "
    try:
        with exit_with_one_line("lerobot-wm"):
            config_type.from_pretrained(folder)
    except SystemExit as end:
        line = str(end)
    assert line.startswith("lerobot-wm: ")
    assert "\n" not in line


@pytest.fixture
def checkpoint(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """A folder for configurations; LeRobot's temporary copies, which it leaves behind, go beside it."""
    monkeypatch.setattr(tempfile, "tempdir", str(tmp_path))
    monkeypatch.setattr("sys.argv", ["lerobot-wm"])
    (tmp_path / "checkpoint").mkdir()
    return tmp_path / "checkpoint"


TEXTS = {kind: configuration(kind) for kind in ("wm_rssm", "wm_bc", "wm_rssm/train")}


@pytest.mark.parametrize("kind", TEXTS)
@settings(FEW, max_examples=10)
@given(data=st.data())
def test_configurations(data: st.DataObject, kind: str, checkpoint: Path) -> None:
    check_configuration(data.draw, kind, checkpoint)


@pytest.mark.slow
@pytest.mark.parametrize("kind", ["wm_rssm", "wm_bc"])
@settings(MANY, max_examples=1000)
@given(data=st.data())
def test_policy_configurations_at_length(data: st.DataObject, kind: str, checkpoint: Path) -> None:
    check_configuration(data.draw, kind, checkpoint)


@pytest.mark.slow
@settings(MANY, max_examples=200)
@given(data=st.data())
def test_training_configurations_at_length(data: st.DataObject, checkpoint: Path) -> None:
    check_configuration(data.draw, "wm_rssm/train", checkpoint)
