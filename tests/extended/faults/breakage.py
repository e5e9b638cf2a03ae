"""Ways to break a dataset; run as a script, commands over datasets, whatever they print and connect to."""

import json
import shutil
import sys
from collections.abc import Callable
from functools import partial
from pathlib import Path
from typing import Any

import pyarrow as pa
import pyarrow.parquet as pq

INFO, STATS, TASKS = "meta/info.json", "meta/stats.json", "meta/tasks.parquet"
EPISODES = "meta/episodes/chunk-000/file-000.parquet"
DATA = "data/chunk-000/file-00{}.parquet"
VIDEO = "videos/observation.images.{}/chunk-000/file-00{}.mp4"

ONE_NUMBER = {"dtype": "float32", "shape": [1], "names": None}

type Fault = Callable[[Path], None]


def write(root: Path, name: str, text: str) -> None:
    """Give a file another content."""
    (root / name).write_text(text)


def cut(root: Path, name: str, keep: float = 0.5) -> None:
    """Keep the beginning of a file."""
    content = (root / name).read_bytes()
    (root / name).write_bytes(content[: int(len(content) * keep)])


def damage(root: Path, name: str, column: str) -> None:
    """Overwrite the values of a column in the first row group of a parquet file; its footer stays."""
    content = bytearray((root / name).read_bytes())
    group = pq.read_metadata(root / name).row_group(0)
    [chunk] = [
        c for c in map(group.column, range(group.num_columns)) if c.path_in_schema.split(".list")[0] == column
    ]
    start = chunk.dictionary_page_offset or chunk.data_page_offset
    content[start : start + chunk.total_compressed_size] = b"\x55" * chunk.total_compressed_size
    (root / name).write_bytes(content)


def remove(root: Path, name: str) -> None:
    """Remove a file or a folder."""
    (shutil.rmtree if (root / name).is_dir() else Path.unlink)(root / name)


def swap(root: Path, one: str, other: str) -> None:
    """Give two files each other's names."""
    (root / one).rename(root / "aside")
    (root / other).rename(root / one)
    (root / "aside").rename(root / other)


def set_entry(root: Path, name: str, keys: list[str], value: Any) -> None:
    """Set an entry of a JSON file."""
    content = json.loads((root / name).read_text())
    place = content
    for key in keys[:-1]:
        place = place[key]
    place[keys[-1]] = value
    (root / name).write_text(json.dumps(content))


def set_value(root: Path, name: str, column: str, row: int, value: Any) -> None:
    """Set a value in a parquet file."""
    table = pq.read_table(root / name)
    values = table[column].to_pylist()
    values[row] = value
    field = table.schema.field(column)
    changed = table.set_column(table.schema.get_field_index(column), field, pa.array(values, field.type))
    pq.write_table(changed, root / name)


def drop_column(root: Path, name: str, column: str) -> None:
    """Take a column out of a parquet file."""
    pq.write_table(pq.read_table(root / name).drop_columns([column]), root / name)


def drop_last_row(root: Path, name: str) -> None:
    """Take the last row out of a parquet file."""
    table = pq.read_table(root / name)
    pq.write_table(table.slice(0, len(table) - 1), root / name)


def duplicate(root: Path, name: str, copy: str) -> None:
    """Copy a file to another name."""
    shutil.copy(root / name, root / copy)


# What is wrong -> (how to break it, the file that the message names, further facts in the message).
FAULTS: dict[str, tuple[Fault, str, list[str]]] = {
    "info.json cut short": (partial(cut, name=INFO), INFO, []),
    "info.json missing": (partial(remove, name=INFO), INFO, []),
    "info.json is a list": (partial(write, name=INFO, text="[]"), INFO, []),
    "info.json nested deeply": (partial(write, name=INFO, text="[" * 100_000), INFO, []),
    "info.json without features": (
        partial(set_entry, name=INFO, keys=["features"], value=None),
        INFO,
        [],
    ),
    "info.json of version 2": (
        partial(set_entry, name=INFO, keys=["codebase_version"], value="v2.1"),
        INFO,
        ["'v2.1'", "v3.0"],
    ),
    "wrong fps": (partial(set_entry, name=INFO, keys=["fps"], value=11), DATA.format(0), ["11", "fps"]),
    "fps of zero": (partial(set_entry, name=INFO, keys=["fps"], value=0), INFO, ["fps"]),
    "wrong number of episodes": (
        partial(set_entry, name=INFO, keys=["total_episodes"], value=5),
        "meta/episodes",
        ["4 episodes", "5 episodes"],
    ),
    "wrong number of frames": (
        partial(set_entry, name=INFO, keys=["total_frames"], value=47),
        "meta/episodes",
        ["46 frames", "47 frames"],
    ),
    "data outside the folder": (
        partial(
            set_entry, name=INFO, keys=["data_path"], value="data/../../{chunk_index}/{file_index}.parquet"
        ),
        DATA.format(0),
        [],
    ),
    "a camera named like a path": (
        partial(set_entry, name=INFO, keys=["features", "observation.images./../../x"], value=ONE_NUMBER),
        INFO,
        ["'observation.images./../../x'"],
    ),
    "stats.json cut short": (partial(cut, name=STATS), STATS, []),
    "stats.json missing": (partial(remove, name=STATS), STATS, ["recompute_stats"]),
    "no statistics of the action": (
        partial(set_entry, name=STATS, keys=["action"], value={}),
        STATS,
        ["min of action", "recompute_stats"],
    ),
    "NaN in the statistics": (
        partial(set_entry, name=STATS, keys=["action", "std"], value=[float("nan"), 1.0]),
        STATS,
        ["std of action", "recompute_stats"],
    ),
    "tasks cut short": (partial(cut, name=TASKS), TASKS, []),
    "tasks missing": (partial(remove, name=TASKS), TASKS, []),
    "a task number twice": (
        partial(set_value, name=TASKS, column="task_index", row=1, value=0),
        TASKS,
        ["[0, 0]"],
    ),
    "episodes cut short": (partial(cut, name=EPISODES), "meta/episodes", []),
    "episodes missing": (partial(remove, name="meta/episodes"), "meta/episodes", []),
    "episodes without lengths": (
        partial(drop_column, name=EPISODES, column="length"),
        "meta/episodes",
        ["'length'"],
    ),
    "an empty episode": (
        partial(set_value, name=EPISODES, column="length", row=2, value=0),
        "meta/episodes",
        ["episode 2"],
    ),
    "an episode of another length": (
        partial(set_value, name=EPISODES, column="length", row=2, value=14),
        "meta/episodes",
        ["episode 3"],
    ),
    "an episode number twice": (
        partial(set_value, name=EPISODES, column="episode_index", row=1, value=0),
        "meta/episodes",
        ["episode 1"],
    ),
    "data cut short": (partial(cut, name=DATA.format(1)), DATA.format(1), []),
    "data empty": (partial(write, name=DATA.format(1), text=""), DATA.format(1), []),
    "data missing": (partial(remove, name=DATA.format(1)), DATA.format(1), []),
    "all data missing": (partial(remove, name="data"), DATA.format(0), []),
    "data swapped": (
        partial(swap, one=DATA.format(0), other=DATA.format(2)),
        DATA.format(0),
        ["15 frames", "12"],
    ),
    "data there twice": (partial(duplicate, name=DATA.format(3), copy=DATA.format(4)), DATA.format(4), []),
    "a frame missing": (partial(drop_last_row, name=DATA.format(0)), DATA.format(0), ["11 frames", "12"]),
    "a frame number twice": (
        partial(set_value, name=DATA.format(1), column="index", row=3, value=14),
        DATA.format(1),
        [],
    ),
    "a video cut short": (partial(cut, name=VIDEO.format("wide", 1)), VIDEO.format("wide", 1), []),
    "a video short of its last byte": (
        partial(cut, name=VIDEO.format("wide", 1), keep=0.999),
        VIDEO.format("wide", 1),
        ["bytes"],
    ),
    "a video empty": (
        partial(write, name=VIDEO.format("wide", 1), text=""),
        VIDEO.format("wide", 1),
        [],
    ),
    "a video missing": (partial(remove, name=VIDEO.format("wide", 1)), VIDEO.format("wide", 1), []),
    "videos swapped between episodes": (
        partial(swap, one=VIDEO.format("wide", 0), other=VIDEO.format("wide", 1)),
        VIDEO.format("wide", 0),
        ["9 frames", "12"],
    ),
}


def run_commands() -> None:
    """Each command line read from stdin as JSON, in this process; JSON lines with the message each ended with.

    Any look-up of an address and any connection is noted, and refused.
    """
    connections: list[str] = []

    def refuse(event: str, arguments: tuple[Any, ...]) -> None:
        if event in ("socket.connect", "socket.getaddrinfo", "socket.gethostbyname", "socket.sendto"):
            connections.append(f"{event} {arguments[1:]}")
            raise OSError("no network in this test")

    sys.addaudithook(refuse)
    from lerobot_wm import cli

    for line in sys.stdin:
        sys.argv = ["lerobot-wm", *json.loads(line)]
        connections.clear()
        message = "(no error)"
        try:
            cli.main()
        except SystemExit as end:
            message = str(end)
        except BaseException as error:
            message = f"(traceback) {error!r}"
        print("RESULT", json.dumps([message, connections]), flush=True)


if __name__ == "__main__":
    run_commands()
