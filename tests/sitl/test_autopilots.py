"""The same suite against real autopilots in software: connect, audit, arm, a step of a body rate,
the release, the hold.

Each is run where its address stands in the environment, and fails where nothing answers there:

    VISTHROW_SITL_ARDUPILOT=tcp:127.0.0.1:5760     arducopter --model quad, or sim_vehicle.py
    VISTHROW_SITL_PX4=udp:127.0.0.1:14540          PX4's offboard port, make px4_sitl sihsim_quadx

They prove protocol, order and failsafes; nothing of aerodynamics, cable or policy. Betaflight's
firmware has tests of its own beside these."""

import os
import time

from pytest import fixture, mark, skip

from hil.links.backends import make_backend
from hil.links.backends.base import FOLLOW, HOLD
from hil.links.backends.mavlink_autopilot import ARMED
from hil.links.device import check_device, open_port
from hil.links.mavlink_link import Link, LinkSync
from hil.links.pymav import mav
from hil.links.roster import Roster
from hil.poses.sources.open_source import parties
from tests.configs import load_run

pytestmark = mark.sitl

ANSWER = 15.0
"""Time in which a running autopilot sends a message [s]."""

STEP, HALF_STEP = 1.5, 0.25
"""Commanded body rate [rad/s], and the time to reach half of it [s]: 55 to 98 ms were measured."""

PERIOD = 0.02
"""Between two commands [s]."""


POSITION = 60.0
"""Longest time of ArduPilot's estimator to a position [s]."""

HOVER_SHARE = {"ardupilot": ("ardupilot.thrust.hover=0.39",), "px4": ()}
"""Hover share of the autopilot's simulated vehicle: with the fakes' share it does not lift, or
shoots away.
"""


class Bench:
    """An autopilot in software, which the test commands directly."""

    def __init__(self, kind: str, *overrides: str):
        address = os.environ.get(f"VISTHROW_SITL_{kind.upper()}")
        if not address:
            skip(f"VISTHROW_SITL_{kind.upper()} is not set")
        names = {"ardupilot": "fake", "px4": "fake_px4"}
        self.kind = kind
        self.params = load_run(names[kind], (*HOVER_SHARE[kind], *overrides))
        port = open_port(check_device(address))
        self.rates, self.placed = [], False
        self.tables: list[str] = []
        self.link = Link(port, 245, 191, roster=Roster(parties(self.params, False, True)))
        LinkSync(self.link)
        self.link.listen(self._hear)
        self.backend = make_backend(self.params, self.link, True, self.tables.append)

    def _hear(self, message, arrival):
        if message.get_type() == "ATTITUDE":
            self.rates.append((arrival, message.rollspeed))
        self.placed |= message.get_type() == "LOCAL_POSITION_NED"

    @property
    def status(self):
        return self.backend.status(time.monotonic())

    def turn(self, seconds, command=None, ask=None, until=None):
        """Run for a time, or until something holds."""
        end = time.monotonic() + seconds
        while (now := time.monotonic()) < end:
            self.link.pump(time.monotonic)
            if command is not None:
                self.backend.send(command, now)
            if ask is not None:
                self.backend.ask(ask, now)
            self.backend.service(now)
            if until is not None and until():
                return True
            time.sleep(PERIOD)
        return until is None

    def stream(self, number: int, interval: float) -> None:
        """Request a message at an interval [us]."""
        values = mav.MAV_CMD_SET_MESSAGE_INTERVAL, 0, number, interval, *[0.0] * 5
        self.link.send(mav.MAVLink_command_long_message(1, 1, *values))

    def heard(self) -> bool:
        return self.backend._heartbeat is not None

    def connect(self):
        assert self.turn(ANSWER, until=self.heard), "nothing answers"
        for number in (mav.MAVLINK_MSG_ID_ATTITUDE, mav.MAVLINK_MSG_ID_SERVO_OUTPUT_RAW):
            self.stream(number, 10_000.0)
        self.turn(ANSWER, until=lambda: self.backend.audit.done)
        if self.kind == "ardupilot":
            for name, value in WRITTEN.items():
                self.backend._write_parameter(name, value)
        return self

    def close(self):
        self.backend.close()
        self.link.close()


@fixture
def bench():
    made = []

    def make(kind, *overrides):
        made.append(Bench(kind, *overrides))
        return made[-1].connect()

    yield make
    for each in made:
        each.close()


KINDS = ("ardupilot", "px4")
NO_MECHANISM = {
    "ardupilot": ("ardupilot.servo_output=9", 'ardupilot.release="servo"'),
    "px4": ("px4.servo_output=0", 'px4.release="actuator"', 'px4.output_parameter=""'),
}
"""Software has no gripper: a bare servo output, an actuator set."""


@mark.parametrize("kind", KINDS)
def test_every_parameter_of_the_audit_exists(bench, kind):
    """Names are those of this firmware: each is answered."""
    desk = bench(kind, *NO_MECHANISM[kind])
    assert desk.tables, "the table is shown"
    assert "no answer" not in desk.tables[0], desk.tables[0]


@mark.parametrize("kind", KINDS)
def test_clocks_are_known(bench, kind):
    desk = bench(kind, *NO_MECHANISM[kind])
    desk.turn(3.0)
    (peer,) = (clock for (system, _), clock in desk.link.sync.peers.items() if system == 1)
    assert peer.offset is not None
    assert peer.round_trip < 0.05


def flying(desk, placed=False):
    """Taken over and armed, commands followed; on the ground, with a thrust that does not lift.

    ``placed``: its position is known.
    """
    params = getattr(desk.params, desk.kind)
    if placed and desk.kind == "ardupilot":
        desk.stream(mav.MAVLINK_MSG_ID_LOCAL_POSITION_NED, 100_000.0)
        assert desk.turn(POSITION, until=lambda: desk.placed), "no position"
    idle = (0.3 * params.thrust.weight, 0.0, 0.0, 0.0)
    desk.turn(30.0, idle, FOLLOW, until=lambda: desk.status.mode == FOLLOW)
    status = desk.status
    assert status.mode == FOLLOW, (status, getattr(desk.backend, "texts", [])[-5:])
    return params


TAKE = {
    "ardupilot": (
        "ardupilot.take=true",
        "ardupilot.arm=true",
        "ardupilot.follow_mode=20",
        "ardupilot.audit=false",
    ),
    "px4": ("px4.arm=true", "px4.audit=false"),
}
"""Bench settings: the runner arms; GUIDED_NOGPS needs no position."""

WRITTEN = {"GUID_OPTIONS": 8.0, "ATC_ANGLE_BOOST": 0.0, "GUID_TIMEOUT": 0.5, "SERVO9_FUNCTION": 0.0}
"""Of ArduPilot: without the first a thrust is a climb rate.

The audit's requirement on its position is left out: here it comes from a GPS.
"""


@mark.parametrize("kind", KINDS)
def test_it_is_taken_and_armed(bench, kind):
    desk = bench(kind, *NO_MECHANISM[kind], *TAKE[kind])
    flying(desk)
    assert desk.backend._heartbeat.base_mode & ARMED


@mark.parametrize("kind", KINDS)
def test_a_step_of_the_roll_rate(bench, kind):
    desk = bench(kind, *NO_MECHANISM[kind], *TAKE[kind])
    params = flying(desk)
    lift = (1.3 * params.thrust.weight, 0.0, 0.0, 0.0)
    desk.turn(1.5, lift)
    start, before = time.monotonic(), len(desk.rates)
    desk.turn(0.4, (*lift[:1], STEP, 0.0, 0.0))
    desk.turn(0.4, (*lift[:1], -STEP, 0.0, 0.0))
    half = [at - start for at, rate in desk.rates[before:] if rate > 0.5 * STEP]
    assert half, "ATTITUDE is to be streamed, and the rate to be followed"
    assert half[0] < HALF_STEP


@mark.parametrize("kind", KINDS)
def test_the_release_is_answered_and_moves(bench, kind):
    desk = bench(kind, *NO_MECHANISM[kind], *TAKE[kind])
    params = flying(desk)
    idle = (0.3 * params.thrust.weight, 0.0, 0.0, 0.0)
    desk.backend.release(time.monotonic())
    desk.turn(5.0, idle, FOLLOW, until=lambda: desk.status.release in ("accepted", "failed"))
    record = desk.backend.release_record
    assert desk.status.release == "accepted", (record.note, record.sends)


@mark.parametrize("kind", KINDS)
def test_the_autopilots_hold_takes_over(bench, kind):
    """It needs a position: in ArduPilot's software from the simulated GPS, in PX4's from any input
    of its estimator.
    """
    more = ("ardupilot.hold_mode=5", "ardupilot.follow_mode=4") if kind == "ardupilot" else ()
    desk = bench(kind, *NO_MECHANISM[kind], *TAKE[kind], *more)
    params = flying(desk, placed=True)
    lift = (1.3 * params.thrust.weight, 0.0, 0.0, 0.0)
    desk.turn(2.0, lift)
    desk.turn(5.0, lift, HOLD, until=lambda: desk.status.mode == HOLD)
    assert desk.status.mode == HOLD, (desk.status, desk.backend.texts[-5:])


@mark.parametrize("kind", KINDS)
def test_silence_ends_in_the_autopilots_hands(bench, kind):
    """PX4 leaves OFFBOARD; ArduPilot stays in its mode and levels."""
    desk = bench(kind, *NO_MECHANISM[kind], *TAKE[kind])
    flying(desk)
    desk.turn(4.5)
    if kind == "ardupilot":
        assert desk.status.mode == FOLLOW
        assert abs(desk.rates[-1][1]) < 0.2
    else:
        assert not desk.status.connected
