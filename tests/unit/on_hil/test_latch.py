"""The latch by itself: when it separates, and what still hangs."""

from pytest import approx, mark, raises

from hil.control.latch import STUCK_AFTER, Latch
from hil.errors import RunError

LAG, HANG, TOLERANCE = 0.05, 0.6, 0.1
ORIGIN = (0.0, 0.0, 0.0)


def latch_of(**changes) -> Latch:
    numbers = {"mechanism_lag": 0.03, "hang": HANG, "tolerance": TOLERANCE, "height": 0.04}
    return Latch(LAG, **numbers | changes)


@mark.parametrize(("delay", "wait"), [(0.0, 0.02), (0.01, 0.03)])
def test_a_faster_mechanism_is_commanded_so_much_later(delay, wait):
    latch = latch_of(command_delay=delay)
    assert latch.trip(1.0, ORIGIN) == approx(1.0 + wait)
    assert [latch.has_separated(1.0 + dt) for dt in (0.0, 0.049, 0.05)] == [False, False, True]


def test_a_mechanism_as_slow_as_the_lag_is_taken_and_a_slower_one_refused():
    assert latch_of(mechanism_lag=LAG + 0.004).trip(1.0, ORIGIN) == 1.0
    with raises(RunError, match="trained with 0"):
        latch_of(mechanism_lag=LAG + 0.006)


@mark.parametrize("distance", [HANG - 0.11, HANG - 0.09, HANG + 0.09, HANG + 0.11])
@mark.parametrize("axis", [0, 1, 2])
def test_a_payload_that_stays_at_the_ropes_end_was_not_released(distance, axis):
    latch = latch_of()
    place = tuple(distance if i == axis else 0.0 for i in range(3))
    assert latch.payload_hangs(0.0, ORIGIN, place) == (distance < HANG + TOLERANCE)
    latch.trip(1.0, ORIGIN)
    due = 1.0 + LAG + STUCK_AFTER
    assert not latch.payload_hangs(due - 0.01, ORIGIN, place), "it may be about to leave"
    assert not latch.payload_hangs(due + 0.01, ORIGIN, None)
    near = abs(distance - HANG) < TOLERANCE
    assert latch.payload_hangs(due + 0.01, ORIGIN, place) == near
    latch.payload_hangs(due + 0.03, ORIGIN, place)
    assert latch.stuck == near, "each throw counts once"
