"""Fixtures of the baseline's tests."""

from unittest import mock

from pytest import fixture


@fixture(scope="module")
def one_start():
    """One start of the plans' optimisation for five, and one process."""
    baseline = "visthrow.paper.baseline"
    one = mock.patch(f"{baseline}.spline.LONGEST", (1.4,))
    with one, mock.patch(f"{baseline}.thrower.cores", return_value=1):
        yield
