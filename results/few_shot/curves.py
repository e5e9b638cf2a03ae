"""The tables and the figure of few-shot transfer, from the records of few_shot.py.

    python results/few_shot/curves.py 'outputs/few_shot/**/*_eval_44_50/records.jsonl'
    python results/few_shot/curves.py results/few_shot/records.jsonl.gz

The names of arms are ARM-TASKS-DEMONSTRATIONS: the tasks of pretraining, 0 where there was none, and the demonstrations
of each test task.
"""

import sys
from pathlib import Path

import numpy as np
from matplotlib.figure import Figure
from rich.console import Console

from lerobot_wm.inspect.pictures import PNG, figure_bytes, tidy
from lerobot_wm.records import (
    Estimate,
    Record,
    find_records,
    group_by_task,
    read_records,
    run_statistics,
    success_rate,
)
from lerobot_wm.report.comparison import Comparison, compare
from lerobot_wm.tables import ReportTable, markdown_table

SCRATCH = ("scratch", 0)

type Curve = dict[int, list[Record]]  # demonstrations -> rollouts


def curves(records: list[Record]) -> dict[tuple[str, int], Curve]:
    """Rollouts by (arm, tasks of pretraining), then by demonstrations; both in order of size."""
    found: dict[tuple[str, int], Curve] = {}
    for record in records:
        arm, tasks, demonstrations = record["arm"].split("-")
        found.setdefault((arm, int(tasks)), {}).setdefault(int(demonstrations), []).append(record)
    return {name: dict(sorted(curve.items())) for name, curve in found.items()}


def named(arm: tuple[str, int]) -> str:
    """An arm in a table."""
    return f"{arm[0]}, {arm[1]} tasks" if arm[1] else arm[0]


def all_counts(found: dict[tuple[str, int], Curve]) -> list[int]:
    """The numbers of demonstrations of which there are results."""
    return sorted({count for curve in found.values() for count in curve})


def area(rates: dict[int, float]) -> float:
    """Mean success over the logarithm of the demonstrations."""
    x = np.log(list(rates))
    return float(np.trapezoid(list(rates.values()), x) / (x[-1] - x[0]))


def success_table(found: dict[tuple[str, int], Curve]) -> ReportTable:
    """Arms down, demonstrations across, and each arm's mean over them minus that of the arm from scratch."""
    counts = all_counts(found)
    means = {
        arm: {count: run_statistics(of_count).mean for count, of_count in curve.items()}
        for arm, curve in found.items()
    }
    areas = {
        arm: area({count: mean.percent for count, mean in of_arm.items()})
        for arm, of_arm in means.items()
        if list(of_arm) == counts and len(counts) > 1
    }
    rows: list[tuple[str, list[str | Estimate | None]]] = [
        (
            named(arm),
            [
                *(of_arm.get(count) for count in counts),
                f"{areas[arm] - areas[SCRATCH]:+.0f}" if {arm, SCRATCH} <= areas.keys() else None,
            ],
        )
        for arm, of_arm in means.items()
    ]
    columns = [f"{count} demonstrations" if count > 1 else "1 demonstration" for count in counts]
    return ReportTable("Success on five tasks", "arm", [*columns, "transfer score"], rows, notes=[])


def difference_table(found: dict[tuple[str, int], Curve], other: tuple[str, int]) -> ReportTable:
    """Arms down, demonstrations across: points ahead of another arm, with the interval over positions."""
    counts = all_counts(found)
    rows = []
    for arm, curve in found.items():
        compared = {
            count: compare(curve[count], found[other][count])
            for count in counts
            if count in curve and count in found[other] and arm != other
        }
        rows.append((named(arm), [_points(compared.get(count)) for count in counts]))
    columns = [str(count) for count in counts]
    return ReportTable(f"Points ahead of {named(other)}, by demonstrations", "arm", columns, rows, notes=[])


def _points(compared: Comparison | None) -> str | None:
    if compared is None:
        return None
    low, high = compared.interval
    return f"{compared.difference:+.0f} [{low:.0f}, {high:.0f}]"


def task_table(found: dict[tuple[str, int], Curve], count: int) -> ReportTable:
    """Arms down, tasks across."""
    with_count = {arm: curve[count] for arm, curve in found.items() if count in curve}
    tasks = sorted({record["task"] for records in with_count.values() for record in records})
    rows = [
        (named(arm), [success_rate(group_by_task(records)[task]) for task in tasks])
        for arm, records in with_count.items()
    ]
    return ReportTable(f"Each task, {count} demonstrations", "arm", tasks, rows, notes=[])


def figure(found: dict[tuple[str, int], Curve]) -> Figure:
    """Success against demonstrations, with 95% intervals."""
    drawing = Figure(figsize=(7, 4.5), layout="constrained")
    axes = drawing.subplots()
    for position, (arm, curve) in enumerate(found.items()):
        means = [run_statistics(records).mean for records in curve.values()]
        shift = 1.02 ** (position - len(found) / 2)  # so that intervals do not hide each other
        rates = np.array([mean.percent for mean in means])
        bounds = np.array([mean.interval for mean in means]).T  # (2, n)
        axes.errorbar(
            np.array(list(curve)) * shift, rates, abs(bounds - rates), label=named(arm), marker="o", capsize=2
        )
    counts = all_counts(found)
    axes.set_xscale("log")
    axes.set_xticks(counts, [str(count) for count in counts])
    axes.minorticks_off()
    axes.set_xlabel("demonstrations of each task")
    axes.set_ylabel("success in %")
    axes.set_ylim(0, 100)
    tidy(axes)
    axes.legend(fontsize=8)
    return drawing


def main() -> None:
    """Print the tables, and draw the figure beside this file."""
    records = read_records(find_records(sys.argv[1]))
    found = curves(records)
    tables = [success_table(found)]
    tables += [
        difference_table(found, other) for other in (SCRATCH, ("demonstrations_only", 0)) if other in found
    ]
    tables += [task_table(found, count) for count in all_counts(found)]
    for table in tables:
        Console().print(markdown_table(table), markup=False, soft_wrap=True, highlight=False)
    Path(__file__).with_name("success.png").write_bytes(figure_bytes(figure(found), PNG))


if __name__ == "__main__":
    main()
