"""Records: one JSON line per rollout, written by `lerobot-wm eval` and read by `lerobot-wm report`."""

import gzip
import json
import platform
import shlex
import sys
from collections.abc import Iterable, Iterator
from contextlib import contextmanager
from glob import glob
from importlib.metadata import version
from pathlib import Path
from typing import Any, NotRequired, TypedDict

import torch

from lerobot_wm.files import sole_writer
from lerobot_wm.system import cpu_kind, usable_cores

# "return" is a Python keyword, hence the functional form.
Record = TypedDict(
    "Record",
    {
        "arm": str,
        "policy_type": str,
        "preset": str,
        "seed": int | None,  # training seed of the policy; None when the checkpoint does not tell
        "task": str,
        "variation": int,  # Meta-World: one of the 50 fixed variations; elsewhere: the environment's seed
        "seen": bool | None,  # was the variation collected on? None where the notion does not exist
        "success": bool,
        "steps": int,  # environment steps until the episode ended
        "return": float,  # sum of rewards over those steps
        "variation_set": NotRequired[
            int | None
        ],  # Meta-World: the set of the variation; older records lack it
    },
)


def record_line(record: Record) -> str:
    """One record as its line of a records file, newline included."""
    return json.dumps(record) + "\n"


def find_records(patterns: str) -> list[Path]:
    """Files named by a comma-separated list of paths and globs, sorted within each glob.

    Raises:
        FileNotFoundError: when an entry of the list matches no file.
    """
    paths: list[Path] = []
    for pattern in patterns.split(","):
        found = sorted(glob(pattern.strip(), recursive=True))
        if not found:
            raise FileNotFoundError(f"No records at '{pattern}': expected files of `lerobot-wm eval`.")
        paths += [Path(path) for path in found if Path(path) not in paths]
    return paths


def read_records(paths: Iterable[Path]) -> list[Record]:
    """All records of the files, in order; files named .gz are compressed.

    Raises:
        ValueError: when a line is not a record, when a rollout occurs twice, when one arm has two presets, when a
            variation is of another set here than there, or when there is no record at all.
    """
    records: list[Record] = []
    origins: dict[tuple, str] = {}
    presets: dict[str, str] = {}
    positions: dict[tuple[str, int, str], tuple[Any, str]] = {}
    for path in paths:
        for number, line in enumerate(_lines(path), start=1):
            record = _parse(line, where=f"{path}:{number}")
            rollout = (record["arm"], record["seed"], record["task"], record["variation"])
            if rollout in origins:
                raise ValueError(
                    f"{path}:{number} repeats the rollout (arm, seed, task, variation) = {rollout} of "
                    f"{origins[rollout]}. Give each run once, and different runs different --arm names."
                )
            origins[rollout] = f"{path}:{number}"
            preset = presets.setdefault(record["arm"], record["preset"])
            if preset != record["preset"]:
                raise ValueError(
                    f"{path}:{number}: arm '{record['arm']}' has preset '{record['preset']}' here, '{preset}' before. "
                    "The seeds of an arm are pooled: report the presets apart, or evaluate under another --arm."
                )
            for name in ("seen", "variation_set"):
                if name not in record:
                    continue
                fact = record[name]
                first, origin = positions.setdefault(
                    (record["task"], record["variation"], name), (fact, origins[rollout])
                )
                if first != fact:
                    raise ValueError(
                        f"{path}:{number}: variation {record['variation']} of {record['task']} has {name} {fact} "
                        f"here, {first} at {origin}: positions of different sets (--env.variation_set), which "
                        "cannot be compared one by one. Report each set apart."
                    )
            records.append(record)
    if not records:
        raise ValueError("The records files are empty: run `lerobot-wm eval` first.")
    return records


def _lines(path: Path) -> list[str]:
    data = path.read_bytes()
    return (gzip.decompress(data) if path.suffix == ".gz" else data).decode().splitlines()


def by_task(records: Iterable[Record]) -> dict[str, list[Record]]:
    """Records by task, tasks in alphabetical order."""
    found: dict[str, list[Record]] = {}
    for record in records:
        found.setdefault(record["task"], []).append(record)
    return dict(sorted(found.items()))


def _parse(line: str, where: str) -> Record:
    try:
        record: Record = json.loads(line)
    except json.JSONDecodeError as error:
        raise ValueError(f"{where} is not JSON ({error}): expected one record per line.") from error
    expected = Record.__required_keys__
    if not isinstance(record, dict) or set(record) - Record.__optional_keys__ != expected:
        found = sorted(record) if isinstance(record, dict) else type(record).__name__
        raise ValueError(f"{where} is not a record: found {found}, expected the keys {sorted(expected)}.")
    return record


COMMAND = "command"
PACKAGES = ("lerobot_policy_wm", "lerobot", "torch", "mujoco", "metaworld", "gymnasium", "numpy")


def by_machine(results: list[dict[str, str]]) -> list[tuple[list[str], dict[str, str]]]:
    """The commands of some results with what they share: versions and kind of machine."""
    found: dict[tuple[tuple[str, str], ...], list[str]] = {}
    for facts in results:
        shared = tuple((name, fact) for name, fact in facts.items() if name != COMMAND)
        found.setdefault(shared, []).append(facts[COMMAND])
    return [(commands, dict(shared)) for shared, commands in found.items()]


def provenance() -> dict[str, str]:
    """What produced a result in this process: name -> value."""
    command = f"{Path(sys.argv[0]).name} {shlex.join(sys.argv[1:])}"
    facts = {COMMAND: command, "python": platform.python_version()}
    facts |= {package: version(package) for package in PACKAGES}
    facts["system"] = f"{platform.system()} {platform.machine()}"
    facts["CPU"] = cpu_kind()
    facts["CPU cores"] = str(usable_cores())
    facts["GPU"] = torch.cuda.get_device_name() if torch.cuda.is_available() else "none"
    return facts


@contextmanager
def new_records(path: Path) -> Iterator[None]:
    """Hold a records file while its rollouts run; earlier records are never written over.

    Raises:
        FileExistsError: It is there already.
        BlockingIOError: Another process writes it.
    """
    with sole_writer(path):
        if path.exists():
            raise FileExistsError(
                f"{path} holds the records of an earlier evaluation: remove it, or give another --output_dir, or "
                "--records of lerobot-wm eval."
            )
        yield
