"""Records: one JSON line per rollout, the success rates computed from them, and what produced a result."""

import gzip
import json
import platform
import shlex
import sys
from collections.abc import Collection, Iterable, Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from glob import glob
from importlib.metadata import version
from pathlib import Path
from typing import Any, NotRequired, TypedDict, cast

import numpy as np
from scipy.stats import binomtest, trim_mean

from lerobot_wm.files import sole_writer
from lerobot_wm.system import cpu_kind, usable_cores

# "return" is a Python keyword, hence the functional form.
Record = TypedDict(
    "Record",
    {
        "arm": str,
        "policy_type": str,
        "preset": str,
        # The policy's training seed; None where the checkpoint does not say.
        "seed": int | None,
        "task": str,
        # In Meta-World one of the 50 fixed variations, elsewhere the environment's seed.
        "variation": int,
        # Whether demonstrations were collected on this variation; None outside Meta-World.
        "seen": bool | None,
        "success": bool,
        # Environment steps until the episode ended.
        "steps": int,
        # Sum of rewards over those steps.
        "return": float,
        # Meta-World's variation set; missing in older records.
        "variation_set": NotRequired[int | None],
    },
)

SPLITS = ("seen", "unseen", "all")
N_RESAMPLES = 10_000
# The same records give the same intervals.
RNG_SEED = 0
COMMAND = "command"
PACKAGES = ("lerobot_policy_wm", "lerobot", "torch", "mujoco", "metaworld", "gymnasium", "numpy")


def record_line(record: Record) -> str:
    """One record as its line of a records file, newline included."""
    return json.dumps(record) + "\n"


@contextmanager
def new_records(path: Path) -> Iterator[None]:
    """Lock a new records file while its rollouts run; existing records are never overwritten.

    Raises:
        FileExistsError: The file exists.
        BlockingIOError: Another process is writing it.
    """
    with sole_writer(path):
        if path.exists():
            raise FileExistsError(
                f"{path} holds the records of an earlier evaluation. Remove it, or choose another --output_dir."
            )
        yield


def find_records(patterns: str) -> list[Path]:
    """Find the files that a comma-separated list of paths and globs names, sorted within each glob.

    Raises:
        FileNotFoundError: An entry of the list matches no file.
    """
    paths: list[Path] = []
    for pattern in patterns.split(","):
        found = sorted(glob(pattern.strip(), recursive=True))
        if not found:
            raise FileNotFoundError(
                f"No file matches '{pattern}': expected records written by `lerobot-wm eval`."
            )
        paths += [Path(path) for path in found if Path(path) not in paths]
    return paths


def read_records(paths: Iterable[Path]) -> list[Record]:
    """Read all records of the files, in order; files named .gz are compressed.

    Raises:
        ValueError: There is no record, a line is not a record, a rollout occurs twice, an arm has two presets, or
            variations of different sets would be compared.
    """
    records: list[Record] = []
    rollouts: dict[tuple, str] = {}  # -> the place of its record
    shared: dict[tuple, tuple[Any, str]] = {}  # what records must agree in -> its first value, and where
    for path in paths:
        for number, line in enumerate(_read_lines(path), start=1):
            place = f"{path}:{number}"
            record = _parse(line, place)
            rollout = (record["arm"], record["seed"], record["task"], record["variation"])
            if rollout in rollouts:
                raise ValueError(
                    f"{place} repeats the rollout (arm, seed, task, variation) = {rollout} of {rollouts[rollout]}. "
                    "Give each run once, and evaluate different runs under different --arm names."
                )
            rollouts[rollout] = place
            arm, _, *variation = rollout
            facts: dict[str, Any] = dict(record)
            for key, owner in (("preset", [arm]), ("seen", variation), ("variation_set", variation)):
                if key not in facts:
                    continue
                value = facts[key]
                first, first_place = shared.setdefault((key, *owner), (value, place))
                if value != first:
                    raise ValueError(
                        f"{place}: {key} of {owner} is {value!r}, but {first!r} at {first_place}. The seeds of an arm "
                        "share one preset, and arms are compared on one variation set (--env.variation_set): report "
                        "the others separately."
                    )
            records.append(record)
    if not records:
        raise ValueError("The records files are empty: run `lerobot-wm eval` first.")
    return records


def _read_lines(path: Path) -> list[str]:
    data = path.read_bytes()
    return (gzip.decompress(data) if path.suffix == ".gz" else data).decode().splitlines()


def _parse(line: str, place: str) -> Record:
    try:
        record = json.loads(line)
    except json.JSONDecodeError:
        record = None
    expected = Record.__required_keys__
    if not isinstance(record, dict) or set(record) - Record.__optional_keys__ != expected:
        raise ValueError(
            f"{place} is not a record: found {line[:80]!r}, expected JSON with the keys {sorted(expected)}."
        )
    return cast(Record, record)


def group_by_task(records: Iterable[Record]) -> dict[str, list[Record]]:
    """Group records by task, in alphabetical order."""
    groups: dict[str, list[Record]] = {}
    for record in records:
        groups.setdefault(record["task"], []).append(record)
    return dict(sorted(groups.items()))


def is_in_split(record: Record, split: str) -> bool:
    """Whether a record belongs to the split "seen", "unseen" or "all"; where `seen` is None, to "all" only."""
    return split == "all" or record["seen"] is (split == "seen")


def present_splits(records: Iterable[Record]) -> tuple[str, ...]:
    """The splits that have records."""
    known = {record["seen"] for record in records}
    return tuple(split for split in SPLITS if split == "all" or (split == "seen") in known)


@dataclass(frozen=True)
class SuccessRate:
    """`successes` of `n` independent rollouts, `n` >= 1."""

    successes: int
    n: int

    @property
    def percent(self) -> float:
        """Successes in percent of the rollouts."""
        return 100 * self.successes / self.n

    @property
    def interval(self) -> tuple[float, float]:
        """The Wilson 95% interval in percent (Wilson 1927); it holds for rates near 0 and 100 too."""
        bounds = binomtest(self.successes, self.n).proportion_ci(confidence_level=0.95, method="wilson")
        return 100 * bounds.low, 100 * bounds.high

    def __str__(self) -> str:
        low, high = self.interval
        return f"{self.successes}/{self.n}  {self.percent:.0f} [{low:.0f}, {high:.0f}]"


def success_rate(records: Iterable[Record]) -> SuccessRate | None:
    """The success rate over these records; None when there are none."""
    successes = [record["success"] for record in records]
    return SuccessRate(sum(successes), len(successes)) if successes else None


def summarize_success(records: Iterable[Record]) -> dict[str, int | float | list[float]]:
    """The rate under the keys of LeRobot's evaluation output, in percent; the interval is [low, high].

    Args:
        records: At least one.
    """
    rate = success_rate(records)
    assert rate is not None
    return {
        "n_episodes": rate.n,
        "n_success": rate.successes,
        "pc_success": rate.percent,
        "pc_success_ci95": list(rate.interval),
    }


@dataclass(frozen=True)
class Estimate:
    """A statistic of success rates and its 95% interval, in percent."""

    percent: float
    interval: tuple[float, float]

    def __str__(self) -> str:
        low, high = self.interval
        return f"{self.percent:.0f} [{low:.0f}, {high:.0f}]"


@dataclass(frozen=True)
class RunStatistics:
    """Mean and interquartile mean (IQM) of an arm's scores; a score is one training seed's success on one task.

    `single_run` says that some task has one training seed only, so that its variations were resampled instead.
    """

    mean: Estimate
    iqm: Estimate
    single_run: bool


def run_statistics(records: list[Record]) -> RunStatistics:
    """Mean and IQM over the scores of one arm, with percentile intervals of the stratified bootstrap.

    Scores are resampled with replacement within each task, so the interval covers the spread between training seeds on
    these variations. It is too narrow for a handful of seeds, and does not know that one multi-task policy's scores
    depend on each other (tests/extended/report/test_bootstrap.py measures both). Where a task has one seed, its
    rollouts are resampled: then the interval covers the choice of variations, not the spread between seeds.
    """
    scores, draws = zip(*_task_scores(records).values(), strict=True)
    all_scores, all_draws = np.concatenate(scores), np.concatenate(draws, axis=1)  # (R·T,), (N, R·T)
    return RunStatistics(
        mean=Estimate(100 * all_scores.mean(), percentile_interval(100 * all_draws.mean(axis=1))),
        iqm=Estimate(
            100 * trim_mean(all_scores, 0.25), percentile_interval(100 * trim_mean(all_draws, 0.25, axis=1))
        ),
        single_run=any(len(of_task) == 1 for of_task in scores),
    )


def mean_over_groups(records: list[Record], groups: Collection[Collection[str]]) -> Estimate:
    """Mean over groups of tasks of each group's mean success, with the interval of `run_statistics`.

    Args:
        records: Of one arm; has all tasks of the groups.
        groups: Names of tasks.
    """
    by_task = _task_scores(records)
    scores = [np.mean([by_task[task][0].mean() for task in group]) for group in groups]  # (G,)
    draws = [np.mean([by_task[task][1].mean(axis=1) for task in group], axis=0) for group in groups]  # (G, N)
    return Estimate(100 * float(np.mean(scores)), percentile_interval(100 * np.mean(draws, axis=0)))


def _task_scores(records: list[Record]) -> dict[str, tuple[np.ndarray, np.ndarray]]:
    """Of each task: the scores of an arm's R seeds (R,), and bootstrap draws of them (N_RESAMPLES, R)."""
    rng = np.random.default_rng(RNG_SEED)
    by_task = {}
    for task, of_task in group_by_task(records).items():
        successes: dict[int | None, list[bool]] = {}
        for record in of_task:
            successes.setdefault(record["seed"], []).append(record["success"])
        scores = np.array([np.mean(of_seed) for of_seed in successes.values()])  # (R,)
        if len(scores) > 1:
            draws = resample(scores, rng)  # (N, R)
        else:
            [of_seed] = successes.values()
            draws = resample(np.array(of_seed, float), rng).mean(axis=1, keepdims=True)  # (N, 1)
        by_task[task] = (scores, draws)
    return by_task


def resample(values: np.ndarray, rng: np.random.Generator) -> np.ndarray:
    """Draw from the values (n,) with replacement: (N_RESAMPLES, n)."""
    return values[rng.integers(len(values), size=(N_RESAMPLES, len(values)))]


def percentile_interval(draws: np.ndarray) -> tuple[float, float]:
    """The 95% percentile interval of a statistic's bootstrap draws (N_RESAMPLES,)."""
    low, high = np.percentile(draws, (2.5, 97.5))
    return float(low), float(high)


def provenance() -> dict[str, str]:
    """What produces a result in this process, name -> value: command, package versions and kind of machine."""
    # Reading records needs no torch.
    import torch

    facts = {
        COMMAND: f"{Path(sys.argv[0]).name} {shlex.join(sys.argv[1:])}",
        "python": platform.python_version(),
    }
    facts |= {package: version(package) for package in PACKAGES}
    facts["system"] = f"{platform.system()} {platform.machine()}"
    facts["CPU"] = cpu_kind()
    facts["CPU cores"] = str(usable_cores())
    facts["GPU"] = torch.cuda.get_device_name() if torch.cuda.is_available() else "none"
    return facts
