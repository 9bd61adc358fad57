"""The bridge to ArduPilot's JSON interface against a fake of the other side, which sends servo
outputs and waits for the state.

Each waits for the other as long as it takes, so that frames alone move the simulator's clock,
however busy the machine is."""

import json
import socket
import struct
import threading

import numpy as np
from numpy.testing import assert_allclose
from pytest import approx, fixture, mark, raises

from hil.errors import LinkError
from hil.links.device import Device, UdpPort
from hil.links.mavlink_link import Link
from hil.rehearsal.bridges import ardupilot_bridge as ardupilot
from hil.rehearsal.bridges.ardupilot_bridge import ArduPilotSitl, outputs
from hil.rehearsal.fake import VEHICLE_ID, FakeOptions
from hil.rehearsal.fake_mocap import FakeMocapParams
from tests.configs import load_run
from visthrow.throws.wire_plant import make_motors

HOVER = 1437
"""Output at which the rotors carry the vehicle [us]: the square root of its weight over four motors
of 3.5 N, a little more.
"""

PATIENCE = 60.0
"""After which a side that says nothing is broken [s]."""


class OtherSide(threading.Thread):
    """Sends frames one after another and keeps the states that come back."""

    def __init__(self, frames, bridge):
        super().__init__(daemon=True)
        self.frames, self.bridge, self.states = frames, bridge, []

    def run(self):
        with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as link:
            link.settimeout(PATIENCE)
            for number, servos in self.frames:
                link.sendto(struct.pack("<HHI16H", 18458, 1000, number, *servos), self.bridge)
                self.states.append(json.loads(link.recv(4096)))


def servos(*motors, hook=1900):
    return (*motors, 1000, 1000, 1000, 1000, hook, *[1000] * 7)


GROUND = servos(1000, 1000, 1000, 1000)


@fixture
def bridge(monkeypatch):
    monkeypatch.setattr(ardupilot, "SERVOS", 0)  # any port that is free
    monkeypatch.setattr(ardupilot, "PATIENCE", PATIENCE)
    params = load_run("ardupilot_sitl").ardupilot
    link = Link(UdpPort(Device("udpout", "127.0.0.1", 14998)), *VEHICLE_ID)
    made = ArduPilotSitl(
        make_motors("vision", 0), link, FakeMocapParams(), 0, FakeOptions(), params
    )
    yield made
    made.close()


def fly(bridge, frames):
    other = OtherSide(frames, bridge.port._open.getsockname())
    other.start()
    bridge.paced = True  # it was heard: its next frame is waited for
    for _ in frames:
        bridge.step()
    other.join(PATIENCE)
    return other.states


def rise(bridge):
    """Fly a hundred frames of a little more than hover."""
    fly(bridge, [(n, servos(*[HOVER + 20] * 4)) for n in range(1, 101)])


def test_each_frame_is_flown_once_and_answered_with_the_state_after_it(bridge):
    """A frame that comes again moves nothing; time goes by the period; the vehicle stands until its
    rotors carry it.
    """
    frames = [(n, GROUND) for n in (1, 2, 2, 3)]
    states = fly(bridge, frames)
    assert [round(state["timestamp"], 6) for state in states] == [0.002, 0.004, 0.004, 0.006]
    assert (bridge.frames, bridge.repeated, bridge.restarts) == (3, 1, 0)
    assert bridge.plant.held
    assert_allclose(
        states[-1]["position"], [1.0, -1.0, -1.0] * bridge.plant.state["pos_w"], atol=1e-6
    )
    assert_allclose(states[-1]["imu"]["accel_body"], [0.0, 0.0, -9.81], atol=0.1)


@mark.parametrize(
    ("change", "axis"),
    [((-30, 0, 0, -30), 0), ((0, -30, 0, -30), 1), ((60, 60, -30, -30), 2)],
    ids=[
        "right side lower: rolls right",
        "rear lower: pitches up",
        "1 and 2, counter-clockwise, faster: yaws right",
    ],
)
def test_motors_turn_the_vehicle_as_ardupilot_means_them(bridge, change, axis):
    """Outputs are front right, rear left, front left, rear right; rates forward, right, down."""
    rise(bridge)
    assert not bridge.plant.held
    states = fly(bridge, [(200 + n, servos(*(HOVER + 20 + np.array(change)))) for n in range(25)])
    gyro = np.array(states[-1]["imu"]["gyro"])
    assert gyro[axis] > 0.02
    assert gyro[axis] > 3.0 * np.abs(np.delete(gyro, axis)).max()


def test_the_mechanisms_output_lets_the_ball_go(bridge):
    rise(bridge)
    fly(bridge, [(101 + n, servos(*[HOVER + 20] * 4, hook=1100)) for n in range(60)])
    report = bridge.report()
    assert report["releases"] == 1
    assert report["separation_time"] == approx(report["release_time"] + 0.06, abs=0.005)


def test_time_goes_on_without_waiting_before_the_first_frame(bridge):
    """Else the plant's clock is behind by all of the time that ArduPilot took to start."""
    bridge.step()
    assert bridge.plant.time == bridge.plant.period
    assert (bridge.frames, bridge.repeated, bridge.paced) == (0, 0, False)


def test_ardupilot_that_falls_silent_is_waited_for_once(bridge, monkeypatch):
    fly(bridge, [(1, GROUND)])
    monkeypatch.setattr(ardupilot, "PATIENCE", 0.01)
    bridge.step()
    assert not bridge.paced


def test_strange_packets_are_none():
    assert outputs(b"") is None
    assert outputs(struct.pack("<HHI16H", 18459, 1000, 1, *[1500] * 16)) is None
    assert outputs(struct.pack("<HHI15H", 18458, 1000, 1, *[1500] * 15)) is None
    number, values = outputs(struct.pack("<HHI32H", 29569, 1000, 7, *range(1000, 1032)))
    assert number == 7
    assert values[31] == 1031.0


def test_ardupilot_that_starts_again_is_counted(bridge):
    fly(bridge, [(50, GROUND), (1, GROUND)])
    assert bridge.restarts == 1


def test_no_other_port_is_advised_than_where_ardupilot_sends(bridge, monkeypatch):
    monkeypatch.setattr(ardupilot, "SERVOS", bridge.port._open.getsockname()[1])
    with raises(LinkError) as caught:
        bridge.connect(None)
    assert str(caught.value).endswith("shows which. End it")
