"""What the page says of a dataset: one that `lerobot-wm collect` made, and others."""

import io
from base64 import b64decode
from pathlib import Path

import numpy as np
from lerobot.datasets.dataset_metadata import LeRobotDatasetMetadata
from lerobot.datasets.lerobot_dataset import LeRobotDataset
from PIL import Image

from lerobot_wm.data.source import SourceConfig
from lerobot_wm.report.training import summarise_data
from tests.recording import FRAME_SHAPES, record_stranger


def picture(data_uri: str) -> np.ndarray:
    """(H, W, 3) uint8."""
    header, content = data_uri.split(",")
    assert header == "data:image/webp;base64"
    return np.asarray(Image.open(io.BytesIO(b64decode(content))))


def test_of_collected_demonstrations(demos: LeRobotDataset) -> None:
    summary = summarise_data(demos.meta, SourceConfig(demos.repo_id, str(demos.root)))
    lengths = demos.meta.episodes["length"][:]
    assert [(t.task, t.name, t.expert, t.n_episodes) for t in summary.tasks] == [
        ("Reach a goal position", "reach-v3", "SawyerReachV3Policy", 4),
        ("Push and close a window", "window-close-v3", "SawyerWindowCloseV3Policy", 4),
    ]
    assert [t.n_frames for t in summary.tasks] == [sum(lengths[:4]), sum(lengths[4:])]
    assert [t.lengths for t in summary.tasks] == [
        (min(part), float(np.median(part)), max(part)) for part in (lengths[:4], lengths[4:])
    ]
    assert summary.facts["frames"].startswith(f"{sum(lengths)}, ")
    assert summary.facts["camera observation.image"] == "64 × 64 pixels"
    assert summary.facts["action"] == "4 numbers per frame"
    assert "0.3" in summary.facts["collected by"], "the noise"
    assert summary.facts["variations"].endswith("0, 1, 2, 3, 4, 5, 6, 7, 8, 9")
    for task, start in zip(summary.tasks, (0, sum(lengths[:4])), strict=True):
        [shown] = task.pictures
        first = (255 * demos[start]["observation.image"]).movedim(0, -1).numpy()
        assert np.abs(picture(shown) - first).mean() < 6


def test_of_any_dataset(tmp_path: Path) -> None:
    dataset = record_stranger(tmp_path / "data", lengths=(10, 12, 14, 16))
    summary = summarise_data(
        LeRobotDatasetMetadata("test/recorded", root=tmp_path / "data"),
        SourceConfig("test/recorded", str(dataset.root)),
    )
    assert [(t.task, t.name, t.expert, t.n_episodes, t.lengths) for t in summary.tasks] == [
        ("Pick up the cup", "", "", 2, (10, 13, 16)),
        ("Open the lid", "", "", 1, (12, 12, 12)),
        ("Wave", "", "", 1, (14, 14, 14)),
    ]
    assert list(summary.facts) == [
        "episodes",
        "frames",
        *(f"camera {key}" for key in FRAME_SHAPES),
        "proprioception",
        "action",
        "reward columns",
    ]
    assert summary.facts["frames"] == "52, 0.1 minutes at 10 frames per second"
    assert summary.facts["reward columns"] == "none"
    assert summary.facts["camera observation.images.front"] == "96 × 128 pixels"
    assert [picture(uri).shape for uri in summary.tasks[2].pictures] == list(FRAME_SHAPES.values())
    first = (255 * dataset[0]["observation.images.front"]).movedim(0, -1).numpy()
    assert np.abs(picture(summary.tasks[0].pictures[0]) - first).mean() < 12, "not of its other episode"
