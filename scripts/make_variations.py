"""Regenerate lerobot_wm/envs/variations.json: the fixed variations of each Meta-World task, 50 in each set.

    python scripts/make_variations.py        (two minutes)

Prints the file's SHA-256, which belongs in lerobot_wm/envs/variations.py.
"""

import hashlib
import json
import pickle

import metaworld
from tqdm import tqdm

from lerobot_wm.constants import VARIATION_SETS
from lerobot_wm.envs.tasks import all_tasks
from lerobot_wm.envs.variations import VARIATIONS_PATH


def rand_vecs(task: str, seed: int) -> list[list[float]]:
    """The 50 vectors that `metaworld.MT1(task, seed)` draws for its training tasks."""
    train_tasks = metaworld.MT1(task, seed=seed).train_tasks
    return [pickle.loads(train_task.data)["rand_vec"].tolist() for train_task in train_tasks]


def set_text(seed: int) -> str:
    """One set as JSON, a task per line so that a change is readable in a diff."""
    lines = [
        f'"{task}": {json.dumps(rand_vecs(task, seed))}' for task in tqdm(all_tasks(), desc=f"set {seed}")
    ]
    return f'"{seed}": {{\n' + ",\n".join(lines) + "\n}"


def main() -> None:
    """Write the file."""
    text = '{"sets": {' + ",\n".join(set_text(seed) for seed in VARIATION_SETS) + "}}\n"
    VARIATIONS_PATH.write_text(text)
    print(f"{VARIATIONS_PATH.name}: SHA-256 {hashlib.sha256(text.encode()).hexdigest()}")


if __name__ == "__main__":
    main()
