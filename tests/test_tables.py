"""The tables of README.md, docs/results.md and docs/speed.md show the committed rollouts and measurements."""

import json
from collections.abc import Iterable
from typing import Any

import pytest
from scipy.stats import binomtest

from benchmarks.table import number
from lerobot_wm.envs.tasks import resolve_tasks
from lerobot_wm.records import Record, read_records
from tests.documents import ROOT, tables

RESULTS = ROOT / "results"
CPU, BEST = "## Preset `cpu`: one fixed camera", "## Preset `best`: cameras on the hand"
PRESETS = [(CPU, "cpu", "records", "success.md"), (BEST, "best", "records_set44", "success_set44.md")]


def rollouts(preset: str, name: str = "records") -> list[Record]:
    [path] = (RESULTS / preset).glob(f"{name}.jsonl*")
    return read_records([path])


def rate(records: Iterable[Record]) -> str:
    """`84 [82, 86]`: per cent, with its Wilson interval."""
    successes = [record["success"] for record in records]
    interval = binomtest(sum(successes), len(successes)).proportion_ci(method="wilson")
    percent = 100 * sum(successes) / len(successes)
    return f"{percent:.0f} [{100 * interval.low:.0f}, {100 * interval.high:.0f}]"


def arm_of(row: dict[str, str]) -> str:
    return row["arm"].strip("`")


@pytest.mark.parametrize(("heading", "preset", "name", "_page"), PRESETS)
def test_success_rates_are_those_of_the_rollouts(heading: str, preset: str, name: str, _page: str) -> None:
    records = rollouts(preset, name)
    table = tables("docs/results.md", heading)[0]
    assert len(table) >= 5
    for row in table:
        of_arm = [r for r in records if r["arm"] == arm_of(row)]
        expected = {"seeds": str(len({r["seed"] for r in of_arm}))}
        for task in resolve_tasks("mt6"):
            title = task.removesuffix("-v3").removesuffix("-topdown")
            expected[title] = rate(r for r in of_arm if r["task"] == task).split()[0]
        expected["unseen"] = rate(r for r in of_arm if not r["seen"])
        expected["all"] = rate(of_arm)
        assert row == {"arm": row["arm"], **expected}


def test_the_spread_over_seeds_is_that_of_the_rollouts() -> None:
    [table] = [table for table in tables("docs/results.md", CPU) if "lowest" in table[0]]
    records = rollouts("cpu")
    for row in table:
        of_arm = [r for r in records if r["arm"] == arm_of(row)]
        seeds = sorted({r["seed"] for r in of_arm})
        successes = [sum(r["success"] for r in of_arm if r["seed"] == seed) for seed in seeds]
        _, mean, lowest, highest = row.values()
        assert mean == f"{sum(successes) / len(seeds):.0f}"
        assert [lowest, highest] == [str(min(successes)), str(max(successes))]


@pytest.mark.parametrize(("heading", "preset", "_name", "page"), PRESETS)
def test_differences_are_those_of_the_report(heading: str, preset: str, _name: str, page: str) -> None:
    [table] = [table for table in tables("docs/results.md", heading) if "against" in table[0]]
    sections = (RESULTS / preset / page).read_text().split("\n## ")
    for row in table:
        _, against, over_variations, over_seeds = row.values()
        [section] = [section for section in sections if section.startswith(f"{arm_of(row)} ")]
        assert f"\n| {against.strip('`')} | {over_variations} | {over_seeds} |" in section


def test_mt10_is_that_of_the_rollouts() -> None:
    records = rollouts("mt10")
    [table] = tables("docs/results.md", "## MT10: ten tasks at once")
    assert {row["task"] for row in table} == {*resolve_tasks("mt10"), "unseen variations", "all"}
    for row in table:
        for title, cell in list(row.items())[1:]:
            of_arm = [r for r in records if r["arm"] == title.strip("`")]
            if row["task"] == "all":
                assert cell == rate(of_arm)
            elif row["task"] == "unseen variations":
                assert cell == rate(r for r in of_arm if not r["seen"])
            else:
                assert cell == rate(r for r in of_arm if r["task"] == row["task"]).split()[0]


def test_readme_shows_unseen_positions() -> None:
    [table] = tables("README.md", "## Results")
    presets = [rollouts("cpu"), rollouts("best", "records_set44")]
    for row in table:
        for records, cell in zip(presets, list(row.values())[2:], strict=True):
            assert cell == rate(r for r in records if r["arm"] == row["policy"].strip("`") and not r["seen"])


def measured(machine: str) -> list[dict[str, Any]]:
    entries: list[dict[str, Any]] = json.loads((RESULTS / "benchmarks" / f"{machine}.json").read_text())
    return entries


def with_spread(entry: dict[str, Any], side: str) -> str:
    return f"{number(entry[side])} [{', '.join(number(value) for value in entry['spread'][side])}]"


def test_speeds_are_those_measured() -> None:
    fast, float32, slower = map(measured, ("cpu2", "cpu2_float32", "cpu2_slower"))
    comparisons, _ = tables("docs/speed.md", "## Two CPU cores, no GPU")
    assert len(comparisons) > 10
    for row in comparisons:
        name = row["row"].strip("`")
        [entry] = [
            e
            for e in fast
            if (e["row"], e["peer_name"]) == (name, row["against"])
            and (with_spread(e, "ours"), with_spread(e, "peer")) == (row["ours"], row["theirs"])
        ]
        assert row["times faster"] == number(entry["ratio"])
        for title, entries in (("without bfloat16", float32), ("slower machine", slower)):
            same = [e for e in entries if all(e[key] == entry[key] for key in ("row", "peer_name", "sizes"))]
            # The environment was drawn in another way on the machine without bfloat16.
            shown = "" if (name, title) == ("env_step", "without bfloat16") else "–"
            if same and shown:
                shown = number(same[0]["ratio"])
            assert row[title] == shown, (name, title)


def test_whole_commands_are_those_measured() -> None:
    _, [evaluation, collection] = tables("docs/speed.md", "## Two CPU cores, no GPU")
    [*_, entry] = [e for e in measured("cpu2_float32") if e["row"] == "evaluation"]
    assert list(evaluation.values())[1:] == [
        number(entry["ours"]),
        entry["peer_name"],
        number(entry["peer"]),
        number(entry["ratio"]),
    ]
    [*_, entry] = [e for e in measured("cpu2") if e["row"] == "collection"]
    assert collection["ours, 1 minute"] == number(entry["ours"])


def test_readme_shows_measured_speeds() -> None:
    shown = {(row["ours"], row["theirs"], row["times faster"]) for row in tables("README.md", "## Speed")[0]}
    entries = [entry for entry in measured("cpu2") if entry["ratio"] is not None]
    assert shown <= {tuple(number(entry[key]) for key in ("ours", "peer", "ratio")) for entry in entries}


def test_precision_is_that_of_the_rollouts() -> None:
    success = json.loads((RESULTS / "precision" / "precision.json").read_text())["success"]
    [table] = tables("docs/speed.md", "## Does bfloat16 cost success?")
    for row in table:
        assert list(row.values())[1:] == [
            success[arm_of(row)][key] for key in ("bfloat16", "float32", "difference")
        ]


def test_pusht_is_that_of_the_evaluations() -> None:
    episodes = json.loads((RESULTS / "pusht" / "episodes.json").read_text())
    [table] = tables("docs/other_environments.md", "## PushT")
    names = ("30,000 steps", "30,000 steps, seed 1", "full state, 30,000 steps")
    for row, name in zip(table, names, strict=False):  # the last row is another's
        rewards, successes = (episodes[name][key] for key in ("max_rewards", "successes"))
        assert list(row.values())[1:3] == [
            f"{sum(rewards) / 200:.3f}".removeprefix("0"),
            f"{sum(successes) / 2:.0f}%",
        ]
