"""Reward, KL and drift from the closed loop, on real episodes with a real (untrained) world model."""

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import torch

from lerobot_wm.constants import REWARD, SUCCESS
from lerobot_wm.data.source import SourceConfig
from lerobot_wm.encode.episodes import Episode
from lerobot_wm.inspect.episodes import Filtered, filter_episodes, load_episodes, load_world_model
from lerobot_wm.inspect.quality_measures import drift, kl_quality, reward_quality
from lerobot_wm.world_model.model import WorldModel
from tests.extended.report.quality_model import lively_world_model

WINDOW = 20  # frames of a training window: not the default of 25


@pytest.fixture(scope="module")
def world_model(untrained_path: Path) -> WorldModel:
    return lively_world_model(untrained_path)


@pytest.fixture(scope="module")
def episodes(demos_root: Path, untrained_path: Path) -> list[Episode]:
    """An episode of each of the two tasks."""
    policy = load_world_model(str(untrained_path))
    return load_episodes(policy, SourceConfig("test/demos", str(demos_root)), [0, 4])


@pytest.fixture(scope="module")
def filtered(world_model: WorldModel, episodes: list[Episode]) -> list[Filtered]:
    return filter_episodes(world_model, episodes)


def succeeding(episode: Episode, success: torch.Tensor) -> Episode:
    return replace(episode, columns=episode.columns | {SUCCESS: success})


@torch.no_grad()
def test_reward_is_judged_at_the_step_it_belongs_to(
    world_model: WorldModel, episodes: list[Episode], filtered: list[Filtered]
) -> None:
    """Label the very steps that the model rates highest: s_t rates the success of frame t - 1."""
    scores = [world_model.predict_reward(loop.latents)[1:] for loop in filtered]
    threshold = torch.cat(scores).quantile(0.9)
    labelled = [
        succeeding(episode, torch.cat([score > threshold, torch.tensor([False])]))
        for episode, score in zip(episodes, scores, strict=True)
    ]
    *_, overall = reward_quality(world_model, labelled, filtered, REWARD)
    assert overall["task"] == "all tasks"
    assert overall["n_steps"] == sum(len(score) for score in scores)
    assert overall["base_rate"] == pytest.approx(0.1, abs=0.01)
    assert (overall["auroc"], overall["average_precision"]) == pytest.approx((1, 1))

    late = [succeeding(episode, episode.columns[SUCCESS].roll(1)) for episode in labelled]
    assert reward_quality(world_model, late, filtered, REWARD)[-1]["average_precision"] < 0.99


def test_steps_that_are_all_alike_rank_nothing(
    world_model: WorldModel, episodes: list[Episode], filtered: list[Filtered]
) -> None:
    failures = [succeeding(episode, torch.zeros(len(episode))) for episode in episodes]
    for row in reward_quality(world_model, failures, filtered, REWARD):
        assert (row["base_rate"], row["auroc"], row["average_precision"]) == (0, None, None)


def test_a_dense_reward_says_nothing_of_success(
    world_model: WorldModel, episodes: list[Episode], filtered: list[Filtered]
) -> None:
    dense = [succeeding(episode, torch.linspace(0, 1, len(episode))) for episode in episodes]
    assert reward_quality(world_model, dense, filtered, REWARD) is None


def test_kl_statistics(episodes: list[Episode], filtered: list[Filtered]) -> None:
    loops = [
        replace(filtered[0], kl=torch.tensor([1.0, 2.0, 3.0, 10.0])),
        replace(filtered[1], kl=torch.ones(4)),
    ]
    quality = kl_quality(episodes, loops, free_nats=3.0)
    first, second, overall = quality["tasks"]
    assert (first["mean"], first["share_under_free_nats"]) == (4, 0.5)
    assert first["percentiles"]["50"] == 2.5
    assert second["share_under_free_nats"] == 1
    assert (overall["mean"], overall["n_steps"]) == (2.5, 8)
    assert sum(quality["histogram"]["counts"]) == 8, "the tail is in the last bin"


@torch.no_grad()
def test_drift_compares_with_a_filter_that_is_restarted(
    world_model: WorldModel, episodes: list[Episode], filtered: list[Filtered]
) -> None:
    rows = drift(world_model, episodes[:1], filtered[:1], WINDOW)
    images, actions = episodes[0].images(), episodes[0].actions

    def by_hand(begin: int, step: int) -> float:
        states = world_model.filter(images[None, begin : step + 1], actions[None, begin : step + 1])
        return -10 * np.log10(
            float((world_model.decode(states.last().latent)[0] - images[step]).square().mean())
        )

    step, begin = WINDOW + 10, 11
    assert rows[step]["psnr"] == pytest.approx(by_hand(0, step), abs=1e-3)
    assert rows[step]["restarted_psnr"] == pytest.approx(by_hand(begin, step), abs=1e-3)
    assert abs(by_hand(0, step) - by_hand(begin, step)) > 0.01, "or the test compares nothing"
    assert rows[WINDOW - 1]["psnr"] == pytest.approx(rows[WINDOW - 1]["restarted_psnr"], abs=1e-3)
    assert rows[WINDOW - 2]["restarted_psnr"] is None
    assert rows[step]["kl"] == pytest.approx(float(filtered[0].kl[step]))


def test_drift_counts_the_episodes_that_reach_a_step(
    world_model: WorldModel, episodes: list[Episode], filtered: list[Filtered]
) -> None:
    lengths = sorted(min(len(episode), 101) for episode in episodes)
    rows = drift(world_model, episodes, filtered, WINDOW)
    assert [row["n_episodes"] for row in rows] == [2] * lengths[0] + [1] * (lengths[1] - lengths[0])
