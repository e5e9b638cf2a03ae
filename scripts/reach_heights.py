"""Which of reach's unseen goals are missed: success by the goal's height above the table.

    python scripts/reach_heights.py --records=results/best/records.jsonl --variation_set=42    (a second)

The hand starts about 20 cm above the table. Of the ten goals of the demonstrations one is higher than 25 cm.
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
    """The goal's height in cm."""
    return 100 * float(rand_vec(TASK, record["variation"], variation_set)[5])


def main() -> None:
    """Print a row for each arm."""
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
