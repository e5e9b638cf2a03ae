"""Compare runs in bfloat16 and in float32: losses, values and success rates.

    scripts/reproduce_table1.py --preset=cpu --arms=wm_iql,wm_bc --seeds=0 --results_dir=outputs/none
    scripts/reproduce_table1.py --preset=cpu_float32
    python results/precision/compare_precision.py --output=results/precision/precision.json

Prints the Markdown tables of the README and writes their numbers as JSON. Takes a minute.
"""

import argparse
import itertools
import json
from pathlib import Path
from typing import Any

from lerobot_wm.constants import TRAIN_LOG_NAME
from lerobot_wm.records import Record, provenance, read_records
from lerobot_wm.report.comparison import compare
from lerobot_wm.statistics import success_rate

MONITORED = {
    "wm_rssm": ("image_loss", "reward_loss", "kl"),
    "wm_iql": ("value_loss", "critic_loss", "actor_loss", "q", "v", "advantage"),
    "wm_bc": ("loss",),
}
PARTS = 5  # each training log is averaged over five parts of equal length


def curves(folder: Path) -> dict[str, dict[str, list[float]]]:
    """Return the mean of each logged value over each part of each run."""
    found: dict[str, dict[str, list[float]]] = {}
    for training, names in MONITORED.items():
        log = [json.loads(line) for line in (folder / training / TRAIN_LOG_NAME).read_text().splitlines()]
        # A resumed run logs some steps twice.
        by_step = list({line["step"]: line for line in log}.values())
        edges = [round(i * len(by_step) / PARTS) for i in range(PARTS + 1)]
        parts = [by_step[low:high] for low, high in itertools.pairwise(edges)]
        found[training] = {
            name: [sum(line[name] for line in part) / len(part) for part in parts] for name in names
        }
    return found


def success(half: list[Record], whole: list[Record]) -> dict[str, dict[str, Any]]:
    """Return, for each arm, success in both precisions and the paired difference."""
    found: dict[str, dict[str, Any]] = {}
    for arm in ("wm_iql", "wm_bc"):
        ours, theirs = ([r for r in records if r["arm"] == arm] for records in (half, whole))
        paired = compare(ours, theirs)
        if paired is None:
            raise ValueError(f"The two runs have no rollout of {arm} in common. Evaluate it in both.")
        low, high = paired.interval
        found[arm] = {
            "bfloat16": str(success_rate(ours)),
            "float32": str(success_rate(theirs)),
            "difference": f"{paired.difference:+.1f} [{low:+.1f}, {high:+.1f}]",
            "won_lost": [paired.only_arm, paired.only_other],
            "p": paired.p_value,
        }
    return found


def tables(document: dict[str, Any]) -> str:
    """Return the document's two tables in Markdown."""
    fifths = " | ".join(f"{i + 1}/{PARTS}" for i in range(PARTS))
    lines = [f"| run | mean over each fifth | precision | {fifths} |", "|---|---|---|" + "---:|" * PARTS]
    for training, names in MONITORED.items():
        for name in names:
            for precision in ("bfloat16", "float32"):
                values = document["curves"][precision][training][name]
                cells = " | ".join(f"{value:.3g}" for value in values)
                lines.append(f"| `{training}` | {name} | {precision} | {cells} |")
    lines += [
        "",
        "| arm | bfloat16 | float32 | difference in points | won–lost | p |",
        "|---|---:|---:|---:|---:|---:|",
    ]
    for arm, row in document["success"].items():
        won, lost = row["won_lost"]
        p = f"{row['p']:.2g}"
        lines.append(
            f"| `{arm}` | {row['bfloat16']} | {row['float32']} | {row['difference']} | {won}–{lost} | {p} |"
        )
    return "\n".join(lines)


def main() -> None:
    """Compare the output folders of two presets."""
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("--bfloat16", type=Path, default=Path("outputs/cpu"))
    parser.add_argument("--float32", type=Path, default=Path("outputs/cpu_float32"))
    parser.add_argument("--output", type=Path, required=True)
    arguments = parser.parse_args()
    folders = {"bfloat16": arguments.bfloat16 / "seed_0", "float32": arguments.float32 / "seed_0"}
    records = [read_records(sorted(folder.glob("eval_wm_*/records.jsonl"))) for folder in folders.values()]
    document = {
        "provenance": provenance(),
        "curves": {precision: curves(folder) for precision, folder in folders.items()},
        "success": success(*records),
    }
    arguments.output.parent.mkdir(parents=True, exist_ok=True)
    arguments.output.write_text(json.dumps(document, indent=1) + "\n")
    print(tables(document))


if __name__ == "__main__":
    main()
