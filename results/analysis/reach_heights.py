"""Success on reach's unseen goals, by the goal's height above the table.

    python results/analysis/reach_heights.py --records=results/best/records.jsonl.gz --variation_set=42

Takes a second. The hand starts about 20 cm above the table. One of the ten goals in the demonstrations is higher
than 25 cm.
"""

import argparse
import itertools
from pathlib import Path

from lerobot_wm.constants import REPORTED_VARIATION_SET, VARIATION_SETS
from lerobot_wm.envs.variations import rand_vec
from lerobot_wm.records import Record, read_records
from lerobot_wm.statistics import in_split, success_rate

TASK = "reach-v3"
EDGES_CM = (5, 10, 15, 20, 25, 30)


def height_cm(record: Record, variation_set: int) -> float:
    """The height of a rollout's goal above the table, in cm."""
    return 100 * float(rand_vec(TASK, record["variation"], variation_set)[5])


def main() -> None:
    """Print one row per arm."""
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("--records", type=Path, required=True)
    parser.add_argument("--variation_set", type=int, choices=VARIATION_SETS, default=REPORTED_VARIATION_SET)
    arguments = parser.parse_args()
    records = [
        record
        for record in read_records([arguments.records])
        if record["task"] == TASK and in_split(record, "unseen")
    ]
    bands = list(itertools.pairwise(EDGES_CM))
    print("arm", *(f"{low}-{high} cm" for low, high in bands), sep=" | ")
    for arm in dict.fromkeys(record["arm"] for record in records):
        own = [record for record in records if record["arm"] == arm]
        rates = [
            success_rate(r for r in own if low <= height_cm(r, arguments.variation_set) < high)
            for low, high in bands
        ]
        print(arm, *rates, sep=" | ")


if __name__ == "__main__":
    main()
