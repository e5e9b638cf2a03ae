from collections.abc import Callable, Iterator

import numpy as np
import pytest

from lerobot_wm.envs.metaworld_mt import MetaworldMTEnv


@pytest.fixture
def make_env() -> Iterator[Callable[..., MetaworldMTEnv]]:
    """Makes environments and closes them after the test."""
    envs: list[MetaworldMTEnv] = []

    def make(task: str, **kwargs: object) -> MetaworldMTEnv:
        envs.append(MetaworldMTEnv(task, **kwargs))
        return envs[-1]

    yield make
    for env in envs:
        env.close()


@pytest.fixture
def actions() -> np.ndarray:
    """Ten random actions, float32 (10, 4)."""
    return np.random.default_rng(0).uniform(-1.0, 1.0, (10, 4)).astype(np.float32)
