"""A vehicle that is not the policy's is refused on the ground, or handed back before it has sunk
0.1 m: of another weight or thrust line, with a rate's sign turned, with its mechanism reversed.
"""

from dataclasses import replace

from pytest import mark, param

from hil.control.loop import Loop
from hil.control.response import AXES
from hil.control.state_machine import State
from hil.links.backends.base import FOLLOW
from tests.hil_flight import AutoOperator
from tests.loopback.test_endings import NEVER
from tests.loopback.wire import CONFIGS, peers
from tests.point import LAG, PointPlant

KINDS = tuple(CONFIGS)
QUICK = ("states.idle=3.0", "states.check=3.0", "states.abort=0.5")
SUNK = 0.1  # [m]
LONGEST = 9.0  # a vehicle that is the policy's has thrown by then [s]


SLOW = 0.5  # time constant of a slow yaw [s]; half of a step after 0.35 s, as PX4's SIH has it
AT_ONCE = 0.10  # time in which a sign is judged by the rates that an autopilot reports [s]
BY_POSES = 0.5  # and by poses alone [s]


def fly(kind, times=1.0, spoil=lambda fake: None, yaw_lag=LAG):
    """Fly until a run is refused, given back or thrown.

    Returns the runner, its messages, and how far the vehicle sank under our control [m].
    """
    taken = () if kind in ("betaflight", "crazyflie") else (f"{kind}.take=true",)
    plant, waits = PointPlant(times, yaw_lag), []
    runner, source, clock, fake = peers(
        plant, kind=kind, loaded=NEVER, seed=3, overrides=(*QUICK, *taken)
    )
    spoil(fake)
    tell = lambda decision: waits.append(decision.waits)  # noqa: E731
    loop, start, sunk = Loop(runner, source, clock, AutoOperator(), None, tell), None, 0.0
    ends = (State.THROW, State.DONE)
    while clock.now() < LONGEST and runner.machine.state not in ends:
        loop.turn(False)
        height = plant.state["pos_w"][2]
        followed = runner.backend.status(clock.now()).mode == FOLLOW
        if not runner.machine.handed_back and runner.machine.flown and followed:
            start = height if start is None else start
            sunk = max(sunk, start - height)
    return runner, f"{runner.machine.reason}; {waits}", sunk


def turn(axis):
    """Spoil a fake: turn the sign of a rate that it follows."""

    def spoil(fake):
        add = fake._set_points.add

        def turned(when, target):
            target[1 + axis] *= -1.0
            add(when, target)

        fake._set_points.add = turned

    return spoil


def bend(share):
    """Spoil a fake: its hover takes another share of thrust."""

    def spoil(fake):
        fake.thrust_map = replace(fake.thrust_map, hover=share * fake.thrust_map.hover)

    return spoil


def reverse(fake):
    """Spoil a fake: its mechanism is open where it was closed."""
    fake.hook_opens = 0
    ends = {"ends": fake.ends[::-1]} if hasattr(fake, "ends") else {}
    fake.__class__ = type("Reversed", (type(fake),), ends)


def require_refused(runner, reasons, sunk):
    """Fail where a run went on, or ended when something was lost."""
    assert (runner.machine.state, runner.machine.throws) == (State.DONE, 0), reasons
    if runner.machine.flown:
        assert runner.machine.handed_back, reasons
        assert sunk < SUNK, reasons


@mark.parametrize("kind", KINDS)
def test_the_policys_vehicle_throws_even_with_a_slow_yaw(kind):
    runner, reasons, sunk = fly(kind, yaw_lag=SLOW)
    assert runner.machine.state is State.THROW, reasons
    assert sunk < SUNK


THRUST = ("times the weight", "thrust: the vehicle")
OTHERS = {
    "half the weight": ({"times": 0.5}, THRUST),
    "twice the weight": ({"times": 2.0}, THRUST),
    "less thrust": ({"spoil": bend(0.8)}, THRUST),
    "more thrust": ({"spoil": bend(1.2)}, THRUST),
    "no yaw": ({"yaw_lag": 1e6}, ("handed back: yaw: the vehicle does not turn as commanded",)),
}
FLOWN = [
    param(name, kind, marks=[mark.slow] * ((i + j) % 2))
    for i, name in enumerate(OTHERS)
    for j, kind in enumerate(KINDS)
]
"""By default each on two of the autopilots; each gets a weight and a thrust."""


@mark.parametrize(("name", "kind"), FLOWN)
def test_another_vehicle_than_the_configuration_says(kind, name):
    flown, reasons = OTHERS[name]
    runner, ended_by, sunk = fly(kind, **flown)
    require_refused(runner, ended_by, sunk)
    assert any(reason in ended_by for reason in reasons)


@mark.parametrize("kind", KINDS)
@mark.parametrize("axis", range(3))
def test_the_sign_of_a_rate(kind, axis):
    runner, reasons, sunk = fly(kind, spoil=turn(axis))
    require_refused(runner, reasons, sunk)
    assert f"handed back: {AXES[axis]}: the vehicle turns against its commands" in reasons
    most = AT_ONCE if runner.response.reported else BY_POSES
    assert runner.response.time <= most + 1e-9


@mark.parametrize("kind", KINDS)
def test_a_mechanism_that_opens_the_other_way(kind):
    runner, reasons, sunk = fly(kind, spoil=reverse)
    require_refused(runner, reasons, sunk)
    assert not runner.machine.flown
    assert "its ends are exchanged" in reasons or "where it should hang" in reasons
