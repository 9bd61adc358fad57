"""The Crazyflie's back-end against its firmware's behaviour by the source, in lock step.

Throws over CRTP, signs, priorities, silence, versions, and what each refuses.
"""

import socket
import struct
import sys

import numpy as np
from pytest import approx, mark, raises

from bench.crazyflie import fly
from bench.processes import free_port
from hil.errors import LinkError
from hil.links import crtp
from hil.links.backends import make_backend
from hil.links.backends.base import ACCEPTED, FAILED, FOLLOW
from hil.links.backends.crazyflie import MODES, Crazyflie
from hil.links.facts import values
from tests.configs import load_run
from tests.fakes.fake_crazyflie import CRASHED, FLYING, LOCKED
from tests.loopback.test_backends import HOVER, Desk

FACTS = values("crazyflie")
NEAR = 0.06
"""Of a single landing [m]: sixty land 0.025 m off in the mean, 0.06 m at most."""


def desk(**options):
    return Desk("crazyflie", **options)


def test_a_whole_throw():
    """Taken, armed, thrown, released and recovered; the vehicle's poses go to its estimator."""
    off, summary, fake = fly(101)
    assert off < NEAR, summary["reason"]
    assert fake.witness.breaches == []
    assert (fake.witness.releases, fake.supervisor) == (1, FLYING)
    place = np.array(fake.placed[-1][0])
    assert len(fake.placed) > 100
    assert np.linalg.norm(place - fake.plant.state["pos_w"]) < 0.1


@mark.parametrize("axis", range(3))
def test_the_vehicle_turns_as_it_was_commanded(axis):
    """Roll right, nose down and yaw left are positive with us."""
    one = desk().follow()
    rates = [0.0, 0.0, 0.0]
    rates[axis] = 1.0
    one.turn(0.06, (HOVER[0], *rates))
    thrust, *turns = one.fake.plant.commands[-1]
    assert thrust == approx(HOVER[0], rel=1e-3)
    assert turns[axis] == approx(1.3 if axis == 2 else 1.0, abs=0.3)
    assert [turn for i, turn in enumerate(turns) if i != axis] == approx([0.0, 0.0])


def test_a_receiver_has_priority():
    one = desk().follow()
    one.turn(0.1, HOVER)
    one.fake.receiver_speaks()
    held = one.fake.held
    one.turn(0.1, HOVER)
    assert one.fake.held is held, "set-points by CRTP are dropped"
    assert one.fake.plant.commands[-1][0] == 0.0


def test_modes_that_others_have_set_are_set_again():
    """Each parameter that changes what a set-point means is put right before anything is armed."""
    wrong = {"flightmode.althold": 1, "flightmode.stabModeYaw": 1, "stabilizer.controller": 2}
    fake = desk(parameters=wrong).follow().fake
    for name, value in FACTS.items():
        if "." in name:
            assert fake.parameters[name] == value


@mark.parametrize("name", ["stabilizer.controller", "hook.open"])
def test_nothing_flies_while_a_setting_is_missing(name):
    tables = []
    one = desk(tell=tables.append)
    del one.fake.parameters[name]
    one.turn(6.0, None, FOLLOW)
    assert not one.fake.armed
    assert one.status.fault == f"parameter audit: {name} wrong, see the table"
    assert "no such parameter" in tables[0]


def test_nothing_is_set_in_flight():
    one = desk(parameters={"stabilizer.controller": 2})
    one.fake.supervisor, one.fake._supervise = FLYING, lambda: None
    one.turn(0.5)
    assert one.status.note == "it flies: land it first"
    assert one.fake.parameters["stabilizer.controller"] == 2


def test_a_firmware_without_manual_set_points_is_refused():
    one = desk()
    one.fake.protocol = 10
    one.turn(1.0, None, FOLLOW)
    assert not one.fake.armed
    assert one.backend.audit.problems == ["protocol is 10; expected 12 or newer"]


@mark.parametrize(("state", "note"), [(LOCKED, "locked: restart it"), (CRASHED, "crashed")])
def test_a_vehicle_that_may_not_fly_any_more_is_reported(state, note):
    one = desk().follow()
    one.turn(0.3, HOVER)
    one.fake.supervisor, one.fake._supervise = state, lambda: None
    one.turn(0.4, HOVER)
    assert note in one.status.note


def test_a_vehicle_that_is_handed_back_holds_its_place():
    one = desk().follow()
    one.turn(0.3, HOVER)
    place = one.fake.plant.state["pos_w"].copy()
    one.backend.place("vehicle", _Track(place))
    for seconds, z in ((1.9, place[2]), (2.1, place[2] - 0.6)):
        for _ in range(round(50 * seconds)):
            one.turn(0.02)
            one.backend.surrender(one.now)
        assert one.fake.supervisor == FLYING, "set-points of a place keep its watchdog quiet"
        assert one.fake.held.place_w == approx((*place[:2], z), abs=0.02)


class _Track:
    """A track of one pose."""

    def __init__(self, place):
        self.place = place

    def sample(self):
        from hil.poses.pose import Pose

        return (Pose(0.0, 0.0, "vehicle", tuple(self.place), (0.0, 0.0, 0.0, 1.0)),)


@mark.parametrize(
    ("answer", "state", "note"),
    [
        ("accepted", ACCEPTED, ""),
        ("denied", FAILED, "not known"),
        ("silent", FAILED, "no final answer"),
    ],
)
def test_a_release_is_answered_or_has_failed(answer, state, note):
    one = desk(answer=answer).follow()
    one.backend.release(one.now)
    one.turn(1.0, HOVER)
    assert one.backend.release_record.state == state
    assert note in one.backend.release_record.note


def test_packets_and_devices(monkeypatch):
    assert crtp.unpack(b"") is None
    assert crtp.unpack(bytes(40)) is None
    packed = struct.pack("<B3fHB", 11, 1.0, -2.0, 3.0, 7, 1)
    assert crtp.manual(7, (1.0, 2.0, 3.0)) == b"\x70" + packed
    assert crtp.set_parameter("a.b", 1) == b"\x23\x00a\0b\0\x08\x01"
    with raises(LinkError, match="is refused"):
        crtp.open_crtp("/bin/sh", False)
    monkeypatch.setitem(sys.modules, "cflib.crtp", None)
    with raises(LinkError, match="crazyflie"):
        crtp.open_crtp("radio://0/80/2M", False)
    assert Crazyflie.holds is False


def test_nobody_else_speaks_for_a_crazyflie():
    """Packets from another address neither connect, nor arm, nor release it: each is counted, and
    their sender reported once.
    """
    ticks, number, messages = 200, free_port(), []
    params = load_run("crazyflie", [f'crazyflie.device="udpout:127.0.0.1:{number}"'])
    backend = make_backend(params, tell=messages.append)
    stranger = socket.socket(socket.AF_INET, socket.SOCK_DGRAM)
    stranger.bind(("127.0.0.2", 0))
    backend.service(0.0)  # sends, so that there is an address to answer
    address = ("127.0.0.1", backend._port._open.getsockname()[1])
    state = FACTS["ask_state"] | FACTS["answer"], FACTS["armed"] | FACTS["flying"]
    answers = [
        (FACTS["port_supervisor"], FACTS["channel_info"], struct.pack("<BI", *state)),
        (
            FACTS["port_platform"],
            FACTS["channel_version"],
            struct.pack("<BI", FACTS["ask_protocol"], FACTS["protocol_state"]),
        ),
    ]
    for name in [*MODES, params.crazyflie.release_parameter]:
        answer = bytes([FACTS["set_by_name"]]) + crtp.encode_name(name) + b"\0"
        answers.append((FACTS["port_param"], FACTS["channel_by_name"], answer))
    for tick in range(ticks):
        backend.ask(FOLLOW, 0.02 * tick)
        backend.release(0.0)
        for answer in answers:
            stranger.sendto(crtp.Packet(*answer).pack(), address)
        backend.service(0.02 * tick)
    status = backend.status(0.02 * ticks)
    assert (status.connected, status.release) == (False, FAILED)
    assert "no answer by CRTP" in status.note
    assert backend.roster.refused == ticks * len(answers)
    host, port = stranger.getsockname()
    refusal = f"refused: datagram from {host}:{port}: the device is 127.0.0.1:{number}"
    assert [text for text in messages if "refused" in text] == [refusal]
    stranger.close()
    backend.close()
