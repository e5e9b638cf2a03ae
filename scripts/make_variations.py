"""Write lerobot_wm/envs/variations.json: 50 fixed variations of each Meta-World task for each variation set.

    python scripts/make_variations.py

Takes two minutes. Prints the SHA-256 of the file, to be copied to lerobot_wm/envs/variations.py.
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
    """Return the 50 vectors that `metaworld.MT1(task, seed)` draws for its training tasks."""
    train_tasks = metaworld.MT1(task, seed=seed).train_tasks
    return [pickle.loads(train_task.data)["rand_vec"].tolist() for train_task in train_tasks]


def set_text(seed: int) -> str:
    """Format one set as JSON, one task per line to keep diffs readable."""
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
