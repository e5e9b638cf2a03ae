"""Figures with names that people chose."""

import warnings
from collections.abc import Callable

import pytest
from matplotlib.figure import Figure

from lerobot_wm.inspect.pictures import PNG, SVG, figure_bytes
from lerobot_wm.report.command import split_figure


@pytest.mark.parametrize("mime_type", [PNG, SVG])
def test_a_name_is_no_formula(mime_type: str) -> None:
    figure = Figure()
    figure.subplots().set_title("$\\frac{$ a dollar's worth")
    assert figure_bytes(figure, mime_type)


def test_a_long_name_leaves_room(make_records: Callable) -> None:
    figure = split_figure(make_records("a_name_without_an_end_" * 10, {"reach-v3": (10, 20)}))
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        assert figure_bytes(figure, SVG)


def test_a_single_arm_has_a_row_of_its_own(make_records: Callable) -> None:
    """Rollouts on unseen variations alone: their mark is level with the arm's name, not on the axis."""
    records = [record for record in make_records("wm_bc", {"reach-v3": (10, 40)}) if not record["seen"]]
    axes = split_figure(records).axes[0]
    assert axes.get_ylim() == (0.5, -0.5)
