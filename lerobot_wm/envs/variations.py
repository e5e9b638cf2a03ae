"""The fixed variations of every Meta-World task: three sets of 50, shipped as data.

A variation is the vector that places a task's objects and goal. Set s has the vectors of
`metaworld.MT1(task, seed=s).train_tasks`; sampling them takes a third of a second per task, reading them none.

- Set 42: demonstrations are collected on variations 0-9, and results are reported on 0-49.
- Set 43: other positions, for choosing settings and testing probes, so that the reported set decides nothing.
- Set 44: a second set for reporting final settings, where earlier ones were also rolled out on set 42.

scripts/make_variations.py regenerates them.
"""

import functools
import hashlib
import json
import re
from pathlib import Path

import numpy as np

from lerobot_wm.constants import NUM_SEEN_VARIATIONS, NUM_VARIATIONS, REPORTED_VARIATION_SET, VARIATION_SETS

VARIATIONS_PATH = Path(__file__).with_name("variations.json")
VARIATIONS_SHA256 = "bc2e8bd895455ce2120df8096758c87a0b297d0ac6d9f89a678c031460d45b00"


@functools.cache
def _load() -> dict[str, dict[str, list[list[float]]]]:
    data = VARIATIONS_PATH.read_bytes()
    digest = hashlib.sha256(data).hexdigest()
    if digest != VARIATIONS_SHA256:
        raise ValueError(
            f"{VARIATIONS_PATH} has SHA-256 {digest}, expected {VARIATIONS_SHA256}: results on changed variations are "
            "not comparable. Reinstall the package or run scripts/make_variations.py."
        )
    return json.loads(data)["sets"]


def rand_vec(task: str, variation: int, variation_set: int = REPORTED_VARIATION_SET) -> np.ndarray:
    """The vector of a variation: 3 to 9 float64 numbers, in metres."""
    return np.array(_load()[str(variation_set)][task][variation], dtype=np.float64)


def check_variation_set(variation_set: int) -> None:
    """Check that a variation set exists.

    Raises:
        ValueError: It does not; names those that do.
    """
    if variation_set not in VARIATION_SETS:
        raise ValueError(
            f"variation_set is {variation_set}; expected one of {', '.join(map(str, VARIATION_SETS))}."
        )


def is_seen(variation: int, variation_set: int = REPORTED_VARIATION_SET) -> bool:
    """Whether demonstrations are collected on a variation."""
    return variation_set == REPORTED_VARIATION_SET and variation < NUM_SEEN_VARIATIONS


def parse_variations(spec: str) -> tuple[int, ...]:
    """Turn "0-4,7" into (0, 1, 2, 3, 4, 7).

    Raises:
        ValueError: The argument is not a list of numbers and ranges from 0 to 49.
    """
    variations: dict[int, None] = {}  # an ordered set
    for entry in spec.split(","):
        match = re.fullmatch(r"(\d+)(?:-(\d+))?", entry.strip())
        if match is None:
            raise ValueError(f"variations is '{spec}'; expected numbers and ranges such as 0-9 or 0-4,7.")
        first, last = match.group(1), match.group(2) or match.group(1)
        variations.update(dict.fromkeys(range(int(first), int(last) + 1)))
    if not variations or max(variations) >= NUM_VARIATIONS:
        raise ValueError(f"variations is '{spec}'; expected numbers from 0 to {NUM_VARIATIONS - 1}.")
    return tuple(variations)
