"""`lerobot-wm quality`, from datasets and a checkpoint to quality.json, figures and the section of the page."""

import json
import logging
import shutil
from collections.abc import Callable
from html.parser import HTMLParser
from pathlib import Path

import numpy as np
import pytest
import torch

from lerobot_wm.constants import ACTION, OBS_IMAGE
from lerobot_wm.data.source import SourceConfig
from lerobot_wm.inspect import quality
from lerobot_wm.inspect.episodes import load_world_model
from lerobot_wm.inspect.open_loop import WINDOW
from lerobot_wm.report.command import template_environment
from lerobot_wm.report.models import read_quality
from tests.recording import camera, record, train_flags, vector


class Section(HTMLParser):
    """What a section shows; fails on tags that do not nest and on anything that is not inlined."""

    def __init__(self, quality_json: Path) -> None:
        super().__init__()
        self.open, self.images, self.text = [], 0, ""
        template = template_environment().get_template("quality_section.html.j2")
        self.feed(template.render(quality=read_quality(quality_json)))
        assert not self.open

    def handle_starttag(self, tag: str, attrs: list) -> None:
        for name, value in attrs:
            assert name not in ("src", "href") or value.startswith("data:image/")
        if tag == "img":
            self.images += 1
        else:
            self.open.append(tag)

    def handle_endtag(self, tag: str) -> None:
        assert self.open.pop() == tag

    def handle_data(self, data: str) -> None:
        self.text += " ".join(data.split()) + " "


def test_by_cross_validation(quality_path: Path, tmp_path: Path) -> None:
    out = shutil.copytree(quality_path.parent, tmp_path / "out")
    result = json.loads((out / "quality.json").read_text())
    assert result["n_episodes"] == 6
    assert result["n_episodes_of_seen_positions"] is None
    assert {row["task"] for row in result["probes"]} >= {"Reach a goal position", "Push and close a window"}
    assert {row["horizon"] for row in result["open_loop"]} == {1, 5, 10, 20, 45}
    assert sum(result["kl"]["histogram"]["counts"]) == sum(t["n_steps"] for t in result["kl"]["tasks"][:-1])
    assert sorted(path.name for path in out.glob("*.[ps][nv]g")) == [
        "quality_drift.svg",
        "quality_examples.png",
        "quality_kl.svg",
        "quality_open_loop.svg",
        "quality_probes.svg",
    ]

    section = Section(out / "quality.json")
    assert section.images == 5
    reach = next(
        row
        for row in result["probes"]
        if (row["task"], row["target"], row["representation"])
        == ("Reach a goal position", "goal", "latent s_t")
    )
    shown = section.text[section.text.index("Position of the goal") :]
    assert f"{reach['median_cm']:.1f} {reach['mean_cm']:.1f} · {reach['r2']:.2f}" in shown
    for name in ("average precision", "logistic regression"):
        assert name in section.text
    result["reward"] = None  # as for a model without a reward head
    result["task_probe"] = []  # as for a dataset of one task
    (out / "quality.json").write_text(json.dumps(result))
    text = Section(out / "quality.json").text
    assert "average precision" not in text
    assert "logistic regression" not in text


def test_fitted_on_the_training_data(
    demos_root: Path,
    untrained_path: Path,
    tmp_path: Path,
    caplog: pytest.LogCaptureFixture,
) -> None:
    with caplog.at_level(logging.WARNING):
        quality.quality(
            quality.QualityConfig(
                str(untrained_path),
                SourceConfig("test/demos", str(demos_root)),
                tmp_path,
                SourceConfig("test/demos", str(demos_root)),
                episodes_per_task=2,
            )
        )
    assert "4 of 4 episodes" in caplog.text
    assert json.loads((tmp_path / "quality.json").read_text())["n_episodes_of_seen_positions"] == 4
    assert "4 of them" in Section(tmp_path / "quality.json").text


def test_a_robots_data_needs_no_simulator(tmp_path: Path, lerobot_wm_command: Callable[..., None]) -> None:
    """One task, a camera of another size, a state, a reward of 0 and 1, no success."""
    features = {
        "observation.images.top": camera(48, 64),
        "observation.state": vector(3),
        "action": vector(2),
        "next.reward": vector(1),
    }
    dataset = record(
        tmp_path / "dataset",
        features,
        [("Lift", WINDOW + 2)] * 4,
        lambda t, length: {"next.reward": np.array([t > length - 5], dtype=np.float32)},
    )
    lerobot_wm_command(
        "train --policy.type=wm_rssm --policy.rssm.deter_dim=8 --policy.rssm.stoch_dim=4 --steps=2 --batch_size=2",
        f"--output_dir={tmp_path / 'wm'} {train_flags(dataset)}",
    )
    checkpoint = tmp_path / "wm" / "checkpoints" / "last" / "pretrained_model"
    lerobot_wm_command(
        f"quality --world_model_path={checkpoint} --dataset.repo_id=test/recorded --dataset.root={dataset.root}",
        f"--output_dir={tmp_path / 'out'}",
    )
    result = json.loads((tmp_path / "out" / "quality.json").read_text())
    assert {row["prediction"] for row in result["open_loop"]} >= {
        "open loop",
        "copy last frame",
        "closed loop",
    }
    assert {row["target"] for row in result["probes"]} == {"observation.state"}
    assert all(row["median_std"] > 0 for row in result["probes"])
    assert result["reward"][0]["auroc"] is not None
    assert "standard deviations" in Section(tmp_path / "out" / "quality.json").text
    result["probes"] = []  # as with too few episodes
    (tmp_path / "out" / "quality.json").write_text(json.dumps(result))
    assert "linear probe" not in Section(tmp_path / "out" / "quality.json").text


@pytest.fixture(scope="module")
def reach_root(tmp_path_factory: pytest.TempPathFactory, lerobot_wm_command: Callable[..., None]) -> Path:
    """Demonstrations of one of the two tasks of `demos_root`, on the other set of variations."""
    root = tmp_path_factory.mktemp("reach") / "dataset"
    lerobot_wm_command(
        "collect --tasks=reach-v3 --episodes_per_task=3 --variations=0-2 --variation_set=43",
        f"--repo_id=test/reach --root={root} --num_workers=1",
    )
    return root


def test_only_tasks_of_both_datasets_are_probed(
    demos_root: Path,
    reach_root: Path,
    untrained_path: Path,
    tmp_path: Path,
    caplog: pytest.LogCaptureFixture,
) -> None:
    reach, demos = SourceConfig("test/reach", str(reach_root)), SourceConfig("test/demos", str(demos_root))
    for judged, trained in ((reach, demos), (demos, reach)):
        with caplog.at_level(logging.WARNING):
            quality.quality(quality.QualityConfig(str(untrained_path), judged, tmp_path, trained))
        result = json.loads((tmp_path / "quality.json").read_text())
        assert {row["task"] for row in result["probes"]} == {"Reach a goal position", "mean of tasks"}
    assert "No probes of 'Push and close a window'" in caplog.text


def test_training_data_of_other_tasks_is_refused(
    reach_root: Path, untrained_path: Path, tmp_path: Path
) -> None:
    dataset = record(tmp_path / "data", {OBS_IMAGE: camera(64, 64), ACTION: vector(4)}, [("Wave", WINDOW)])
    config = quality.QualityConfig(
        str(untrained_path),
        SourceConfig("test/reach", str(reach_root)),
        tmp_path / "out",
        SourceConfig("test/recorded", str(dataset.root)),
    )
    with pytest.raises(ValueError, match=r"test/recorded.*Reach a goal position.*--train_dataset"):
        quality.quality(config)
    assert not (tmp_path / "out").exists()


def test_the_untrained_model_has_other_weights_and_the_same_scaling(untrained_path: Path) -> None:
    trained = load_world_model(str(untrained_path)).world_model
    trained.action_scaling.set_range(torch.full((4,), -2.0), torch.full((4,), 2.0))
    before = torch.random.get_rng_state()
    fresh, again, other = (quality.untrained(trained, seed) for seed in (3, 3, 4))
    assert torch.equal(before, torch.random.get_rng_state())
    assert torch.equal(fresh.action_scaling.scale, trained.action_scaling.scale)
    weights = [model.rssm.prior_hidden.weight for model in (trained, fresh, again, other)]
    assert torch.equal(weights[1], weights[2])
    assert not torch.equal(weights[0], weights[1])
    assert not torch.equal(weights[1], weights[3])


def test_a_missing_file_is_named(tmp_path: Path) -> None:
    with pytest.raises(FileNotFoundError, match=r"quality\.json.*--quality"):
        read_quality(tmp_path / "quality.json")
