"""Updates of d3rlpy's IQL and BC with our network sizes and settings, on a batch in memory."""

from pathlib import Path

import d3rlpy
import numpy as np
from d3rlpy.algos import BCConfig, IQLConfig
from d3rlpy.algos.qlearning.base import QLearningAlgoBase
from d3rlpy.dataset import TransitionMiniBatch
from d3rlpy.models.encoders import VectorEncoderFactory

from benchmarks.sides.shared import (
    ACTION_DIM,
    BETA,
    DISCOUNT,
    DROPOUT,
    EXPECTILE,
    HIDDEN_DIMS,
    LEARNING_RATE,
    OBSERVATION_DIM,
    TARGET_RATE,
)
from benchmarks.timing import Prepared, timed_updates


def iql(folder: Path, batch: int, seconds: float) -> Prepared:
    """Time updates of IQL, target networks included."""
    network = VectorEncoderFactory(hidden_units=HIDDEN_DIMS)
    config = IQLConfig(
        actor_learning_rate=LEARNING_RATE,
        critic_learning_rate=LEARNING_RATE,
        actor_encoder_factory=VectorEncoderFactory(hidden_units=HIDDEN_DIMS, dropout_rate=DROPOUT),
        critic_encoder_factory=network,
        value_encoder_factory=network,
        batch_size=batch,
        gamma=DISCOUNT,
        tau=TARGET_RATE,
        expectile=EXPECTILE,
        weight_temp=BETA,
    )
    return _prepared(config.create(device="cpu:0"), batch, seconds)


def bc(folder: Path, batch: int, seconds: float) -> Prepared:
    """Time updates of BC."""
    config = BCConfig(
        batch_size=batch,
        learning_rate=LEARNING_RATE,
        encoder_factory=VectorEncoderFactory(hidden_units=HIDDEN_DIMS, dropout_rate=DROPOUT),
    )
    return _prepared(config.create(device="cpu:0"), batch, seconds)


def _prepared(algorithm: QLearningAlgoBase, batch: int, seconds: float) -> Prepared:
    rng = np.random.default_rng(0)
    reward = (rng.random((batch, 1)) < 0.1).astype(np.float32)  # (B, 1)
    action = rng.uniform(-1, 1, (batch, ACTION_DIM)).astype(np.float32)  # (B, A)
    data = TransitionMiniBatch(
        observations=rng.normal(size=(batch, OBSERVATION_DIM)).astype(np.float32),
        actions=action,
        rewards=reward,
        next_observations=rng.normal(size=(batch, OBSERVATION_DIM)).astype(np.float32),
        next_actions=action,
        terminals=reward,
        intervals=np.ones_like(reward),
        transitions=[],
    )
    algorithm.create_impl((OBSERVATION_DIM,), ACTION_DIM)
    return timed_updates(
        lambda: algorithm.update(data), seconds, {"dtype": "float32", "d3rlpy": d3rlpy.__version__}
    )
