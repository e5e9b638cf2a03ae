"""The success tables: per task, over all tasks, compared with the paper's Table 1, and arm against arm."""

from dataclasses import dataclass, replace

from lerobot_wm.constants import MT6
from lerobot_wm.envs.tasks import tasks_by_tier
from lerobot_wm.records import (
    N_RESAMPLES,
    Record,
    SuccessRate,
    group_by_task,
    is_in_split,
    mean_over_groups,
    present_splits,
    run_statistics,
    success_rate,
)
from lerobot_wm.report.comparison import DENSE_SUFFIX, Comparison, compare_arms, group_by_arm
from lerobot_wm.tables import WILSON, Cell, ReportTable

ROLLOUTS_PER_CELL = 50
MAX_TASKS_ACROSS = 10


@dataclass(frozen=True)
class PaperArm:
    """A column of the paper's Table 1: the success rate on each task, in the order of MT6, and the overall rate."""

    name: str
    rates: tuple[float, ...]
    overall: float

    def cells(self) -> list[SuccessRate]:
        """The rates as counts, in the order of MT6."""
        return [SuccessRate(round(rate * ROLLOUTS_PER_CELL), ROLLOUTS_PER_CELL) for rate in self.rates]

    def all_tasks(self) -> SuccessRate:
        """The rate over all cells, which does not always equal the printed overall rate."""
        return SuccessRate(sum(cell.successes for cell in self.cells()), ROLLOUTS_PER_CELL * len(MT6))


# Our arm -> the paper's.
PAPER_TABLE: dict[str, PaperArm] = {
    "e2e_iql": PaperArm("Multitask from scratch, IQL", (0.04, 0.42, 0, 0.04, 0.28, 0.08), 0.1433),
    "e2e_bc": PaperArm("Multitask from scratch, BC", (0.12, 0.7, 0.02, 0.24, 0.5, 0.4), 0.33),
    "e2e_iql_single": PaperArm("Individual, IQL", (0.14, 1, 0, 0.94, 0.42, 0.72), 0.5367),
    "e2e_bc_single": PaperArm("Individual, BC", (0.32, 0.98, 0.38, 0.26, 0.84, 0.64), 0.5733),
    "wm_iql": PaperArm("Multitask World Model, IQL", (0.2, 0.92, 0.74, 0.22, 0.96, 0.84), 0.6466),
    "wm_bc": PaperArm("Multitask World Model, BC", (0.3, 0.9, 0.82, 0.2, 1, 0.72), 0.6567),
}
PAPER_NOTES = (
    "The paper has one training seed and one rollout on each of 50 variations, on version 2 of the tasks, with "
    "demonstrations of an MTSAC agent. It prints no intervals: the Wilson intervals are computed here from its rates.",
    "The printed overall rates are the means of the cells (0.6466 is truncated, not rounded), except for Individual "
    "BC: its cells average 0.57, but 0.5733 is printed.",
    "The paper trains its end-to-end IQL arms on dense reward and its world-model arms on sparse 0/1 reward. Here the "
    "arms named _dense learn from dense reward and all other IQL arms from 0/1 reward.",
)
POOLED = f"{WILSON} The seeds of an arm are pooled, and their rollouts treated as independent."
IQL_NOTE = (
    "With 0/1 reward and episodes that end at success, Q and V lie in [0, 1], so at β 0.5 every weight lies in "
    "[0.61, 1.65] and IQL is nearly BC. IQL arms have β 0.5, except wm_iql_beta0, wm_iql_beta3 and wm_iql_beta10."
)
COMPARISON_NOTES = [
    "Difference: percentage points over the variations that both arms were rolled out on. Each seed of one arm is "
    "paired with each seed of the other; arms on a shared world model are paired by equal seeds. The 95% bootstrap "
    "interval covers the choice of variations: they are resampled within each task, each with all its pairs.",
    "Over seeds: 95% t interval that covers the choice of training seeds, where both arms have several (Welch's; "
    "paired by seed on a shared world model).",
    "Won–lost: pairs of rollouts in which only this arm, or only the other, succeeded. p: exact McNemar test, where "
    "both arms have one seed. There is no correction for the number of comparisons.",
]


def task_table(title: str, records: list[Record]) -> ReportTable:
    """Arms down, tasks across; tasks down where there are many."""
    tasks = list(group_by_task(records))
    rows = [(arm, _task_cells(of_arm, tasks)) for arm, of_arm in group_by_arm(records).items()]
    table = ReportTable(title, "arm", tasks, rows, notes=[POOLED])
    return table if len(tasks) <= MAX_TASKS_ACROSS else table.transposed("task")


def tier_table(records: list[Record]) -> ReportTable | None:
    """Arms down; the four tiers of LeRobot's Meta-World page and their mean across; None without all 50 tasks."""
    tiers = tasks_by_tier()
    if set(group_by_task(records)) != {task for tasks in tiers.values() for task in tasks}:
        return None
    rows: list[tuple[str, list[Cell]]] = []
    for arm, of_arm in group_by_arm(records).items():
        cells = [success_rate(r for r in of_arm if r["task"] in tasks) for tasks in tiers.values()]
        has_all = len(group_by_task(of_arm)) == sum(map(len, tiers.values()))
        rows.append((arm, [*cells, mean_over_groups(of_arm, tiers.values()) if has_all else None]))
    columns = [f"{tier} ({len(tasks)} tasks)" for tier, tasks in tiers.items()]
    return ReportTable("Tiers of difficulty", "arm", [*columns, "mean of tiers"], rows, notes=[POOLED])


def seed_table(records: list[Record]) -> ReportTable:
    """Each training seed by itself: seeds down, tasks and all tasks across."""
    tasks = list(group_by_task(records))
    rows: list[tuple[str, list[Cell]]] = []
    for arm, of_arm in group_by_arm(records).items():
        for seed in dict.fromkeys(record["seed"] for record in of_arm):
            run = [record for record in of_arm if record["seed"] == seed]
            rows.append((f"{arm}, seed {seed}", [*_task_cells(run, tasks), success_rate(run)]))
    return ReportTable("Each training seed", "run", [*tasks, "all tasks"], rows, notes=[WILSON])


def overall_table(records: list[Record]) -> ReportTable:
    """Arms down; number of seeds, seen, unseen and all variations, mean and IQM across."""
    splits, arms = present_splits(records), group_by_arm(records)
    rows: list[tuple[str, list[Cell]]] = []
    single = []
    for arm, of_arm in arms.items():
        statistics = run_statistics(of_arm)
        if statistics.single_run:
            single.append(arm)
        pooled = [success_rate(r for r in of_arm if is_in_split(r, split)) for split in splits]
        n_seeds = len({record["seed"] for record in of_arm})
        rows.append((arm, [n_seeds, *pooled, statistics.mean, statistics.iqm]))
    return ReportTable(
        "All tasks",
        "arm",
        ["seeds", *splits, "mean", "IQM"],
        rows,
        notes=[*_bootstrap_notes(single, len(arms)), *_training_notes(list(arms))],
    )


def paper_comparison(records: list[Record]) -> ReportTable | None:
    """The paper's Table 1 and our rows of the same arms; None unless the records' tasks are the paper's six."""
    if set(group_by_task(records)) != set(MT6):
        return None
    ours = group_by_arm(records)
    rows: list[tuple[str, list[Cell]]] = []
    for arm, paper in PAPER_TABLE.items():
        of_arm = ours.get(arm, [])
        rows.append((arm, [*_task_cells(of_arm, MT6), success_rate(of_arm), None]))
        if dense := ours.get(arm + DENSE_SUFFIX):
            rows.append((arm + DENSE_SUFFIX, [*_task_cells(dense, MT6), success_rate(dense), None]))
        rows.append((f"  paper's {arm}", [*paper.cells(), paper.all_tasks(), f"{paper.overall:g}"]))
    names = "; ".join(f"{arm} is “{paper.name}”" for arm, paper in PAPER_TABLE.items())
    notes = [f"The paper's names: {names}.", *PAPER_NOTES]
    return ReportTable(
        "Compared with the paper's Table 1", "arm", [*MT6, "all tasks", "printed overall"], rows, notes=notes
    )


def comparison_tables(records: list[Record]) -> list[ReportTable]:
    """A table for each arm of `COMPARED_ARMS` that has records, against the others; the last one has the notes."""
    tables = [_comparison_table(comparisons) for comparisons in compare_arms(records).values()]
    return [*tables[:-1], *(replace(last, notes=COMPARISON_NOTES) for last in tables[-1:])]


def _comparison_table(comparisons: list[Comparison]) -> ReportTable:
    rows: list[tuple[str, list[Cell]]] = []
    for c in comparisons:
        difference = f"{c.difference:+.1f} {_interval_text(c.interval)}"
        over_seeds = None if c.seed_interval is None else _interval_text(c.seed_interval)
        p_value = None if c.p_value is None else "<0.001" if c.p_value < 0.001 else f"{c.p_value:.3f}"
        won_lost = f"{c.only_arm}–{c.only_other}"
        rows.append((c.other, [difference, over_seeds, won_lost, p_value, c.n_pairs, c.verdict]))
    arm = comparisons[0].arm
    columns = ["difference", "over seeds", "won–lost", "p", "pairs", f"{arm} is"]
    return ReportTable(f"{arm} against each other arm", "against", columns, rows)


def _task_cells(records: list[Record], tasks: list[str] | tuple[str, ...]) -> list[Cell]:
    by_task = group_by_task(records)
    return [success_rate(by_task.get(task, [])) for task in tasks]


def _bootstrap_notes(single: list[str], n_arms: int) -> list[str]:
    notes = [
        "Seen, unseen, all: success over all rollouts, with [Wilson 95% intervals]. Mean and IQM (mean of the middle "
        "half): over the success rates of all seeds and tasks, with [95% stratified bootstrap intervals, "
        f"{N_RESAMPLES:,} resamples]."
    ]
    if len(single) < n_arms:
        notes.append(
            "Arms with several seeds: seeds are resampled within each task, so the interval covers training seeds. "
            "With three seeds it is too narrow: in simulations it held the true value about 80% of the time, and about "
            "60% where a seed is good or bad at all tasks at once."
        )
    if single:
        notes.append(
            f"Arms with one seed ({', '.join(single)}): their variations are resampled within each task, so the "
            "interval covers the choice of variations, not training seeds."
        )
    return notes


def _training_notes(arms: list[str]) -> list[str]:
    dense = [arm for arm in arms if arm.endswith(DENSE_SUFFIX)]
    notes = []
    if dense:
        notes.append(f"Trained on dense reward: {', '.join(dense)}. All other IQL arms: sparse 0/1 reward.")
    if any("iql" in arm for arm in arms):
        notes.append(IQL_NOTE)
    return notes


def _interval_text(interval: tuple[float, float]) -> str:
    low, high = interval
    return f"[{low:+.1f}, {high:+.1f}]"
