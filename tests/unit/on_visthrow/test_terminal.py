"""Plots in characters: marks stand where their values say."""

import math

import pytest

from visthrow.view import terminal


def test_a_curve_falls_from_left_to_right_on_a_logarithmic_axis():
    falling = [(t, 1.0 * 0.1 ** (t / 10.0)) for t in range(11)]
    lines = terminal.curve([(".", falling)], 22, 11, "[m]")
    assert len(lines) == 13
    marks = [
        (row, line.index(".") - 8)
        for row, line in enumerate(lines[:11])
        if "." in line[8:]
        for line in ["        " + line[8:]]
    ]
    assert [row for row, _ in marks] == list(range(11))  # a straight line
    assert [column for _, column in marks] == sorted(column for _, column in marks)
    assert lines[0].startswith("     1 |")
    assert lines[10].startswith("   0.1 |")
    assert lines[-1].endswith("10 s")


def test_later_series_stand_over_earlier_ones_and_what_is_no_number_is_left_out():
    lines = terminal.curve(
        [(".", [(1.0, 0.1), (2.0, math.nan), (3.0, -1.0)]), ("o", [(1.0, 0.1)])], 20, 5, "[m]"
    )
    text = "".join(line[8:] for line in lines[:5])
    assert text.count("o") == 1
    assert "." not in text


def test_an_empty_curve_is_an_empty_frame():
    assert len(terminal.curve([(".", [])], 20, 5, "[m]")) == 7


def test_a_scatter_counts_by_place():
    points = [(0.0, 0.0)] * 12 + [(0.09, 0.09), (-5.0, 0.0)]
    lines = terminal.scatter(points, 0.1, 10, 10)
    assert lines[6][6] == "9"  # the middle, of twelve
    assert lines[1][10] == "1"  # right and up
    assert lines[6][1] == "1"  # beyond the reach, at the left edge
    assert sum(c.isdigit() for c in "".join(lines)) == 3
    assert terminal.scatter([], 0.1, 10, 10)[6][6] == "+"


def test_blocks_stand_side_by_side():
    assert terminal.side_by_side(["ab", "c"], ["x"], 2) == ["ab  x", "c"]


@pytest.mark.parametrize(
    ("seconds", "text"), [(0, "0:00"), (65.2, "1:05"), (3661, "1:01:01"), (math.inf, "-")]
)
def test_clock(seconds, text):
    assert terminal.clock(seconds) == text
