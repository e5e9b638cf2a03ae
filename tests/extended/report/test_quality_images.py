"""Image error of predictions, against values worked out by hand and against the open-loop section of the report."""

from dataclasses import replace
from pathlib import Path

import pandas as pd
import pytest
import torch

from lerobot_wm.constants import ACTION, OBS_STATE, SUCCESS
from lerobot_wm.data.source import SourceConfig
from lerobot_wm.encode.episodes import Episode
from lerobot_wm.inspect.episodes import filter_episodes, load_episodes, load_world_model
from lerobot_wm.inspect.open_loop import WINDOW, predict
from lerobot_wm.inspect.quality import spread_over_variations
from lerobot_wm.inspect.quality_measures import (
    PREDICTIONS,
    image_errors,
    mean_and_median_image,
    predictions,
    summarise,
)
from lerobot_wm.inspect.quality_probes import probe_targets, start_positions, variation_of
from tests.extended.report.quality_model import lively_world_model


@pytest.fixture(scope="module")
def all_episodes(demos_root: Path, untrained_path: Path) -> list[Episode]:
    policy = load_world_model(str(untrained_path))
    return load_episodes(policy, SourceConfig("test/demos", str(demos_root)), list(range(8)))


@pytest.fixture(scope="module")
def episodes(all_episodes: list[Episode]) -> list[Episode]:
    return [episode for episode in all_episodes if len(episode) >= WINDOW]


def test_errors_of_constructed_images() -> None:
    truth = torch.zeros(1, 5, 3, 16, 16)
    truth[..., :4, :4] = 1  # the foreground: 16 of 256 pixels
    half, background_off = truth / 2, truth.clone()
    background_off[..., 4:, :] = 0.1
    images = {"truth": truth, "open loop": half, "shuffled actions": background_off}
    images |= {name: torch.zeros_like(truth) for name in ("copy last frame", "mean image")}
    images["closed loop"] = truth
    rows = summarise(image_errors(images, ["a task"], median_image=torch.zeros(3, 16, 16)))
    table = pd.DataFrame(rows).query("task == 'a task' and horizon == 5").set_index("prediction")

    assert list(table.index) == list(PREDICTIONS)
    assert table["foreground_share"].tolist() == [1 / 16] * 5
    assert table["foreground_psnr"].tolist() == pytest.approx([6.0206, 100, 0, 0, 100], abs=1e-3)
    # Squared errors 0.25/16, 0.01·192/256, 1/16, 1/16 and none.
    assert table["psnr"].tolist() == pytest.approx([18.0618, 21.2494, 12.0412, 12.0412, 100], abs=1e-3)
    assert table["ssim"]["closed loop"] == pytest.approx(1)
    assert table["ssim"]["copy last frame"] < table["ssim"]["open loop"] < 1
    overall = pd.DataFrame(rows).query("task == 'all tasks' and horizon == 5")
    assert overall["psnr"].tolist() == table["psnr"].tolist()


def test_an_image_without_foreground_has_no_foreground_psnr() -> None:
    images = dict.fromkeys(("truth", *PREDICTIONS), torch.zeros(1, 5, 3, 16, 16))
    rows = summarise(image_errors(images, ["a task"], median_image=torch.zeros(3, 16, 16)))
    assert {row["foreground_psnr"] for row in rows} == {None}


def test_what_passes_by_is_in_the_mean_but_not_in_the_median_image(episodes: list[Episode]) -> None:
    frames = torch.full((50, 64, 64, 3), 100, dtype=torch.uint8)
    frames[:20, :8] = 200  # there for 2 of the 5 frames taken
    mean, median = mean_and_median_image([replace(episodes[0], frames=[frames])])
    torch.testing.assert_close(median, torch.full((3, 64, 64), 100 / 255))
    assert mean[0, 0, 0].item() == pytest.approx(140 / 255)


def test_open_loop_is_that_of_the_report(
    untrained_path: Path, demos_root: Path, episodes: list[Episode]
) -> None:
    policy = load_world_model(str(untrained_path))
    policy.world_model = lively_world_model(untrained_path)
    one_task = [episode for episode in episodes if episode.task == episodes[-1].task]
    assert len(one_task) > 1
    filtered = filter_episodes(policy.world_model, one_task)
    mean, median = mean_and_median_image(one_task)
    images = predictions(policy.world_model, one_task, filtered, mean, seed=0)
    table = pd.DataFrame(summarise(image_errors(images, [episode.task for episode in one_task], median)))
    table = table.query("task != 'all tasks'")

    window = slice(WINDOW)
    source = SourceConfig("test/demos", str(demos_root))
    expected = predict(policy, load_episodes(policy, source, [e.index for e in one_task], WINDOW))
    of = {name: table[table["prediction"] == name]["psnr"].tolist() for name in PREDICTIONS}
    assert of["open loop"] == pytest.approx(expected.psnr, abs=1e-3)
    assert of["copy last frame"] == pytest.approx(expected.copy_psnr, abs=1e-3)
    with torch.no_grad():
        whole = policy.world_model.filter(one_task[0].images(window)[None], one_task[0].actions[None, window])
        torch.testing.assert_close(
            images["closed loop"][0, -1], policy.world_model.decode(whole.last().latent)[0]
        )


def test_shuffled_actions_are_another_episodes(untrained_path: Path, episodes: list[Episode]) -> None:
    world_model = lively_world_model(untrained_path)
    two = [episodes[0], episodes[-1]]
    filtered = filter_episodes(world_model, two)
    mean, _ = mean_and_median_image(two)
    swapped = [
        replace(episode, columns=episode.columns | {ACTION: other.actions})
        for episode, other in (two, two[::-1])
    ]
    images = predictions(world_model, two, filtered, mean, seed=0)
    shuffled = images["shuffled actions"]
    assert (shuffled - images["open loop"]).abs().max() > 0.01
    torch.testing.assert_close(
        shuffled, predictions(world_model, swapped, filtered, mean, seed=0)["open loop"]
    )


@torch.no_grad()
def test_filtering_in_batches_is_filtering_one_by_one(untrained_path: Path, episodes: list[Episode]) -> None:
    world_model = lively_world_model(untrained_path)
    assert len({len(episode) for episode in episodes}) > 1, "or nothing is padded"
    for episode, loop in zip(episodes, filter_episodes(world_model, episodes), strict=True):
        states = world_model.filter(episode.images()[None], episode.actions[None])
        torch.testing.assert_close(loop.latents, states.latent[0], atol=1e-5, rtol=1e-4)
        assert loop.kl.shape == episode.columns[SUCCESS].flatten().shape
        assert bool((loop.kl > 0).all())


def test_episodes_are_spread_over_variations() -> None:
    table = pd.DataFrame(
        [(task, variation) for task in (0, 1) for variation in range(5) for _ in range(4)],
        columns=["task_index", "variation"],
    ).rename_axis("episode_index")
    table = table.reset_index()
    chosen = spread_over_variations(table, per_task=7, seed=0)
    counts = table.set_index("episode_index").loc[chosen].value_counts().sort_index()
    assert counts.groupby("task_index").sum().tolist() == [7, 7]
    assert set(counts) == {1, 2}, "each of the 5 variations once, and two of them twice"
    assert chosen == spread_over_variations(table, per_task=7, seed=0)
    assert chosen != spread_over_variations(table, per_task=7, seed=1)


def test_positions_tell_variations_apart(all_episodes: list[Episode]) -> None:
    names = {(episode.task, variation_of(episode)) for episode in all_episodes}
    starts = {(episode.task, start_positions(episode)) for episode in all_episodes}
    assert len(starts) == len(names)


def test_a_dataset_without_positions_has_its_vectors_as_targets(
    episodes_root: Path, untrained_path: Path
) -> None:
    source = SourceConfig("test/episodes", str(episodes_root))
    episodes = load_episodes(load_world_model(str(untrained_path)), source, [0, 3])
    for episode in episodes:
        assert list(probe_targets(episode)) == [OBS_STATE]
        assert probe_targets(episode)[OBS_STATE].shape == episode.actions.shape
    assert [variation_of(episode) for episode in episodes] == [0, 3]
