"""The success tables by arm: per task, over all tasks, beside the paper's Table 1, and arm against arm."""

from dataclasses import replace

from lerobot_wm.constants import MT6
from lerobot_wm.report.arms import DENSE_SUFFIX, by_arm
from lerobot_wm.report.bootstrap import N_RESAMPLES, run_statistics
from lerobot_wm.report.comparison import Comparison, compare_arms
from lerobot_wm.report.paper_table import ODDITIES, PAPER_TABLE
from lerobot_wm.report.records import Record, by_task
from lerobot_wm.report.statistics import in_split, success_rate
from lerobot_wm.report.tables import WILSON, Cell, ReportTable, present_splits

POOLED = f"{WILSON} The seeds of an arm are pooled; their rollouts are taken as independent."
IQL_NOTE = (
    "With 0/1 reward and success-termination Q and V lie in [0, 1], so at β 0.5 each weight lies in [0.61, 1.65]: "
    "IQL is nearly BC. The IQL arms have β 0.5; the sweep is wm_iql_beta0, wm_iql_beta3, wm_iql_beta10."
)
PAIRED = (
    "Percentage points over the variations that both arms were rolled out on; each training of the one is paired with "
    "each of the other, but for arms on a shared world model, which are paired by training seed. [95% bootstrap "
    "interval]: variations are resampled within each task, each with all its pairs; it covers the choice of "
    "variations. Over trainings: 95% t interval of the difference between trainings on these variations (Welch; by "
    "seed on a shared world model), where both arms have several. won–lost: pairs in which only the one, only the "
    "other succeeded. p: exact McNemar test where both have one training. Not corrected for the number of comparisons."
)


def task_table(title: str, records: list[Record]) -> ReportTable:
    """Arms down, tasks across."""
    tasks = list(by_task(records))
    rows = [(arm, _task_cells(of_arm, tasks)) for arm, of_arm in by_arm(records).items()]
    return ReportTable(title, "arm", tasks, rows, notes=[POOLED])


def seed_table(records: list[Record]) -> ReportTable:
    """Each training seed by itself: runs down, tasks and all tasks across."""
    tasks = list(by_task(records))
    rows: list[tuple[str, list[Cell]]] = []
    for arm, of_arm in by_arm(records).items():
        for seed in dict.fromkeys(record["seed"] for record in of_arm):
            run = [record for record in of_arm if record["seed"] == seed]
            rows.append((f"{arm}, seed {seed}", [*_task_cells(run, tasks), success_rate(run)]))
    return ReportTable("Each training seed", "run", [*tasks, "all tasks"], rows, notes=[WILSON])


def overall_table(records: list[Record]) -> ReportTable:
    """Arms down; seeds, seen, unseen and all variations, mean and IQM of the runs across."""
    splits, arms = present_splits(records), by_arm(records)
    rows: list[tuple[str, list[Cell]]] = []
    single = []
    for arm, of_arm in arms.items():
        statistics = run_statistics(of_arm)
        if statistics.single_run:
            single.append(arm)
        pooled = [success_rate(r for r in of_arm if in_split(r, split)) for split in splits]
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
    """The paper's Table 1 and our rows of the same arms; None for records of other tasks than the paper's six."""
    if set(by_task(records)) != set(MT6):
        return None
    ours = by_arm(records)
    rows: list[tuple[str, list[Cell]]] = []
    for arm, paper in PAPER_TABLE.items():
        of_arm = ours.get(arm, [])
        rows.append((arm, [*_task_cells(of_arm, MT6), success_rate(of_arm), None]))
        if dense := ours.get(arm + DENSE_SUFFIX):
            rows.append((arm + DENSE_SUFFIX, [*_task_cells(dense, MT6), success_rate(dense), None]))
        rows.append((f"  paper's {arm}", [*paper.cells(), paper.all_tasks(), f"{paper.overall:g}"]))
    names = "; ".join(f"{arm} is “{paper.name}”" for arm, paper in PAPER_TABLE.items())
    notes = [f"The paper's names: {names}.", *ODDITIES]
    return ReportTable(
        "Beside the paper's Table 1", "arm", [*MT6, "all tasks", "printed overall"], rows, notes=notes
    )


def comparison_tables(records: list[Record]) -> list[ReportTable]:
    """A table for each arm of `COMPARED_ARMS` that has records, against the others."""
    tables = [_comparison_table(comparisons) for comparisons in compare_arms(records).values()]
    return [*tables[:-1], *(replace(last, notes=[PAIRED]) for last in tables[-1:])]


def _comparison_table(comparisons: list[Comparison]) -> ReportTable:
    rows: list[tuple[str, list[Cell]]] = []
    for c in comparisons:
        difference = f"{c.difference:+.1f} {_interval_text(c.interval)}"
        over_trainings = "–" if c.training_interval is None else _interval_text(c.training_interval)
        won_lost = f"{c.only_arm}–{c.only_other}"
        rows.append(
            (c.other, [difference, over_trainings, won_lost, _p_text(c.p_value), c.n_pairs, c.verdict])
        )
    title = f"{comparisons[0].arm} against each other arm"
    columns = ["difference", "over trainings", "won–lost", "p", "pairs", comparisons[0].arm + " is"]
    return ReportTable(title, "against", columns, rows)


def _task_cells(records: list[Record], tasks: list[str] | tuple[str, ...]) -> list[Cell]:
    found = by_task(records)
    return [success_rate(found.get(task, [])) for task in tasks]


def _bootstrap_notes(single: list[str], n_arms: int) -> list[str]:
    notes = [
        "Seen, unseen, all: rollouts pooled, [Wilson 95%]. Mean and IQM (mean of the middle half): of the success "
        f"rates of seeds x tasks, [95% stratified bootstrap, {N_RESAMPLES:,} resamples]."
    ]
    if len(single) < n_arms:
        notes.append(
            "Several seeds: runs are resampled within each task; the interval covers the training seeds. From three "
            "seeds it is too narrow: in simulations it held the truth about 80% of the time, and about 60% where a "
            "seed is good or bad at all tasks at once."
        )
    if single:
        notes.append(
            f"One seed ({', '.join(single)}): the variations of the one run are resampled within each task; the "
            "interval covers the choice of variations, not the spread between training seeds."
        )
    return notes


def _training_notes(arms: list[str]) -> list[str]:
    dense = [arm for arm in arms if arm.endswith(DENSE_SUFFIX)]
    notes = []
    if dense:
        notes.append(
            f"Trained on dense reward: {', '.join(dense)}. Every other IQL arm: on the sparse 0/1 reward."
        )
    if any("iql" in arm for arm in arms):
        notes.append(IQL_NOTE)
    return notes


def _interval_text(interval: tuple[float, float]) -> str:
    low, high = interval
    return f"[{low:+.1f}, {high:+.1f}]"


def _p_text(p_value: float | None) -> str:
    if p_value is None:
        return "–"
    return "<0.001" if p_value < 0.001 else f"{p_value:.3f}"
