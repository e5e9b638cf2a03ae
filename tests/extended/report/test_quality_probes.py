"""Probes recover what is there, fail where nothing is, and never see a variation they are tested on."""

from pathlib import Path

import numpy as np
import pandas as pd
import pytest

from lerobot_wm.data.source import SourceConfig
from lerobot_wm.inspect.episodes import filter_episodes, load_episodes, load_world_model
from lerobot_wm.inspect.quality_probes import (
    BLIND,
    EMBEDDING,
    FRAMES_PER_EPISODE,
    LATENT,
    MEAN_OF_TASKS,
    PIXELS,
    POSITIONS,
    UNTRAINED,
    Frames,
    draw_frames,
    probe_positions,
    probe_targets,
    probe_task,
    splits,
)

VARIATIONS, PER_VARIATION = 10, 15


@pytest.fixture(scope="module")
def frames() -> Frames:
    """Two tasks whose latent holds the positions linearly, in its smaller directions; the rest holds other things."""
    rng = np.random.default_rng(0)
    n = 2 * VARIATIONS * PER_VARIATION
    tasks = np.repeat(["first", "second"], n // 2)
    variations = np.tile(np.repeat(np.arange(VARIATIONS), PER_VARIATION), 2)
    targets = {name: rng.normal(0, 0.1, (n, 3)) for name in POSITIONS}
    goals = rng.normal(0, 0.1, (2 * VARIATIONS, 3))
    targets["goal"] = goals[variations + VARIATIONS * (tasks == "second")]
    position = np.hstack(list(targets.values()))  # (N, 9)
    is_second = 10.0 * (tasks == "second")[:, None]
    mixture, _ = np.linalg.qr(rng.normal(size=(30, 30)))
    features = {
        LATENT: np.hstack([position, is_second, rng.normal(0, 3, (n, 20))]) @ mixture,
        EMBEDDING: np.eye(VARIATIONS)[variations],
        UNTRAINED: rng.normal(size=(n, 30)),
        PIXELS: np.hstack(
            [position, rng.normal(0, 1e-3, (n, 200))]
        ),  # as components: large ones and small ones
        BLIND: np.zeros((n, 1)),
    }
    return Frames(features, targets, tasks, variations, to_fit=None)


@pytest.fixture(scope="module")
def table(frames: Frames) -> pd.DataFrame:
    return positions(frames)


def positions(frames: Frames) -> pd.DataFrame:
    return pd.DataFrame(probe_positions(frames)).set_index(["task", "target", "representation"]).sort_index()


def test_a_linear_target_is_recovered_and_noise_is_not(table: pd.DataFrame) -> None:
    # A grid of penalties that began at 10 made latents look half as precise as they are.
    for target in POSITIONS:
        found, nothing = table.loc[("first", target, LATENT)], table.loc[("first", target, UNTRAINED)]
        blind = table.loc[("first", target, BLIND)]
        assert found["r2"] > 0.95
        assert found["median_cm"] < 0.3 * blind["median_cm"]
        assert nothing["r2"] < 0.1
        assert nothing["mean_cm"] > 0.9 * blind["mean_cm"]
    tasks = table.xs("goal", level="target")["mean_cm"].unstack("task")
    np.testing.assert_allclose(tasks[MEAN_OF_TASKS], (tasks["first"] + tasks["second"]) / 2)


def test_small_components_do_not_drown_large_ones(table: pd.DataFrame) -> None:
    # Standardised like the other representations, 200 components of noise hid the 9 that matter.
    assert table.loc[("first", "gripper", PIXELS)]["r2"] > 0.95


def test_knowing_the_variation_by_heart_does_not_help(table: pd.DataFrame) -> None:
    # Split by frame, the goal of each variation would be read off exactly.
    assert table.loc[("first", "goal", EMBEDDING)]["r2"] < 0


def test_the_blind_probe_is_the_mean_of_what_it_was_fitted_on(frames: Frames) -> None:
    fitted = Frames(frames.features, frames.targets, frames.tasks, frames.variations, frames.variations < 5)
    of_task = frames.tasks == "second"
    goal = frames.targets["goal"]
    mean = goal[of_task & (frames.variations < 5)].mean(axis=0)
    error = 100 * np.linalg.norm(goal[of_task & (frames.variations >= 5)] - mean, axis=1)
    row = positions(fitted).loc[("second", "goal", BLIND)]
    assert row["median_cm"] == pytest.approx(np.median(error))
    assert row["mean_cm"] == pytest.approx(error.mean())


def test_splits_share_no_variation(frames: Frames) -> None:
    rows = np.flatnonzero(frames.tasks == "second")
    parts = splits(frames, rows)
    assert len(parts) == 5
    for fit, test in parts:
        assert not set(frames.variations[fit]) & set(frames.variations[test])
        assert set(frames.tasks[fit]) == {"second"}
    assert sorted(np.concatenate([test for _, test in parts])) == rows.tolist(), "each frame is tested once"


def test_too_few_variations_have_no_probes(frames: Frames, caplog: pytest.LogCaptureFixture) -> None:
    assert splits(frames, np.flatnonzero(frames.variations < 2)) == []
    assert "'first'" in caplog.text


def test_other_vectors_are_read_in_standard_deviations(frames: Frames) -> None:
    goal = 1000 * frames.targets["goal"]
    targets = {"observation.state": np.hstack([goal, np.ones((len(goal), 1))])}  # one number never changes
    other = Frames(frames.features, targets, frames.tasks, frames.variations, to_fit=None)
    table = positions(other)
    found, blind = (table.loc[("first", "observation.state", name)] for name in (LATENT, BLIND))
    assert found["r2"] > 0.95
    assert found["median_std"] < 0.3
    assert blind["mean_std"] == pytest.approx(1, abs=0.25)


def test_the_task_is_found_where_it_is_represented(frames: Frames) -> None:
    accuracy = {row["representation"]: row["accuracy"] for row in probe_task(frames)}
    assert accuracy[LATENT] > 0.99
    assert accuracy[BLIND] == 0.5
    assert accuracy[UNTRAINED] < 0.65


def test_one_task_needs_no_probe(frames: Frames) -> None:
    rows = frames.tasks == "first"
    first = Frames(
        {name: x[rows] for name, x in frames.features.items()},
        {name: values[rows] for name, values in frames.targets.items()},
        frames.tasks[rows],
        frames.variations[rows],
        to_fit=None,
    )
    assert probe_task(first) == []


def test_frames_of_real_episodes(demos_root: Path, untrained_path: Path) -> None:
    policy = load_world_model(str(untrained_path))
    world_model = policy.world_model
    episodes = load_episodes(policy, SourceConfig("test/demos", str(demos_root)), [0, 1, 4, 5])
    filtered = filter_episodes(world_model, episodes)
    frames = draw_frames(episodes, filtered, filtered, n_fit=2, seed=0)
    assert frames.to_fit.tolist() == [i < 2 for i in range(4) for _ in range(FRAMES_PER_EPISODE)]
    rows = {tuple(row) for row in frames.targets["goal"][:FRAMES_PER_EPISODE].tolist()}
    assert rows <= {tuple(row) for row in probe_targets(episodes[0])["goal"].tolist()}
    assert frames.features[PIXELS].shape == frames.features[LATENT].shape
    # Components keep their proportions: scaled to equal variance, the least of them would drown the first.
    variances = frames.features[PIXELS][frames.to_fit].var(axis=0, ddof=1)
    assert variances.mean() == pytest.approx(1, rel=1e-3)
    assert variances[0] > 10 * variances[-1]
