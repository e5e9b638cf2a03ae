"""Intervals and grouping against known numbers."""

import math
from collections.abc import Callable

import pytest

from lerobot_wm.records import SuccessRate, is_in_split, success_rate


def test_wilson_interval_of_the_papers_table() -> None:
    # 0.647, 0.657 and 0.573 of 300 rollouts (Table 1 of the paper).
    for successes, low, high in ((194, 59, 70), (197, 60, 71), (172, 52, 63)):
        interval = SuccessRate(successes, 300).interval
        assert [round(bound) for bound in interval] == [low, high]


@pytest.mark.parametrize(("k", "n"), [(0, 50), (1, 50), (25, 50), (49, 50), (50, 50)])
def test_wilson_interval_against_its_formula(k: int, n: int) -> None:
    z, p = 1.959963984540054, k / n
    centre = (p + z**2 / (2 * n)) / (1 + z**2 / n)
    half = z / (1 + z**2 / n) * math.sqrt(p * (1 - p) / n + z**2 / (4 * n**2))
    assert SuccessRate(k, n).interval == pytest.approx(
        (100 * (centre - half), 100 * (centre + half)), abs=1e-9
    )


def test_rate_reads_as_counts_percent_and_interval() -> None:
    assert str(SuccessRate(45, 50)) == "45/50  90 [79, 96]"


def test_splits(make_records: Callable) -> None:
    records = make_records("wm_bc", {"reach-v3": (4, 15)})
    assert success_rate(r for r in records if is_in_split(r, "seen")) == SuccessRate(4, 10)
    assert success_rate(r for r in records if is_in_split(r, "unseen")) == SuccessRate(15, 40)
    assert success_rate(r for r in records if is_in_split(r, "all")) == SuccessRate(19, 50)
    elsewhere = records[0] | {"seen": None}
    assert [split for split in ("seen", "unseen", "all") if is_in_split(elsewhere, split)] == ["all"]


def test_no_rollouts_have_no_rate() -> None:
    assert success_rate([]) is None
