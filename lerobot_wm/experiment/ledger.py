"""The records of an experiment: every finished arm and seed once, in files that are never incomplete."""

from pathlib import Path

from lerobot_wm.experiment.preset import Preset
from lerobot_wm.files import write_whole
from lerobot_wm.records import Record, read_records, record_line

type Runs = dict[tuple[str, int | None], list[Record]]  # by (arm, seed)


class Ledger:
    """The records of an experiment by (arm, seed): committed ones, and those of its own rollouts.

    It contains an arm and seed once all its rollouts are recorded, one on every variation of every task. Committed
    records take precedence. Own ones are stored separately, so that another run can do without the committed ones.

    Args:
        path: File for all records; the own ones are beside it in `own_<name>`.
        committed: Records that count without the output folders of their runs.
        preset: Says which rollouts an arm and seed has.

    Raises:
        ValueError: A file holds something other than records, or records of another preset.
    """

    def __init__(self, path: Path, committed: Path, preset: Preset) -> None:
        self.path = path
        self._own_path = path.with_name(f"own_{path.name}")
        self._preset = preset.name
        self._rollouts = {(task, k) for task in preset.task_names for k in preset.variations}
        self._committed = self._complete_runs(committed)
        self._own = self._complete_runs(self._own_path)

    def __contains__(self, run: tuple[str, int]) -> bool:
        """Whether an arm and seed is finished."""
        return run in self._committed or run in self._own

    def is_committed(self, run: tuple[str, int]) -> bool:
        """Whether the records of an arm and seed are committed."""
        return run in self._committed

    @property
    def empty(self) -> bool:
        """Whether nothing is finished."""
        return not self._committed and not self._own

    def add(self, arm: str, seed: int, files: list[Path]) -> None:
        """Add the rollouts of a finished arm and seed, unless they are recorded already.

        Raises:
            ValueError: The files hold other rollouts, or rollouts of another preset.
        """
        if (arm, seed) in self:
            return
        records = self._read(files)
        if set(_by_run(records)) != {(arm, seed)} or not self._is_complete(records):
            found = sorted({(record["arm"], record["seed"]) for record in records}, key=str)
            raise ValueError(
                f"{', '.join(map(str, files))}: {len(records)} rollouts of (arm, seed) {found}; expected the "
                f"{len(self._rollouts)} of ('{arm}', {seed}). Remove their folders to roll out again."
            )
        self._own[arm, seed] = records
        _write(self._own_path, self._own)

    def write(self) -> None:
        """Write all records to one file."""
        _write(self.path, self._own | self._committed)

    def _complete_runs(self, file: Path) -> Runs:
        if not file.is_file() or not file.stat().st_size:
            return {}
        return {run: rows for run, rows in _by_run(self._read([file])).items() if self._is_complete(rows)}

    def _read(self, files: list[Path]) -> list[Record]:
        records = read_records(files)
        others = {record["preset"] for record in records} - {self._preset}
        if others:
            raise ValueError(
                f"{', '.join(map(str, files))}: rollouts of the preset {', '.join(sorted(map(str, others)))}; "
                f"expected '{self._preset}'. Use another --output_dir or --results_dir."
            )
        return records

    def _is_complete(self, records: list[Record]) -> bool:
        return {(record["task"], record["variation"]) for record in records} == self._rollouts


def _by_run(records: list[Record]) -> Runs:
    """Records by (arm, seed), in order."""
    runs: Runs = {}
    for record in records:
        runs.setdefault((record["arm"], record["seed"]), []).append(record)
    return runs


def _write(path: Path, runs: Runs) -> None:
    write_whole(path, "".join(record_line(record) for rows in runs.values() for record in rows))
