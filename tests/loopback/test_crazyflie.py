"""The Crazyflie's back-end and its fake: a whole throw over CRTP in lock step, signs, and what each
refuses.
"""

import math
import sys

import numpy as np
import pytest

from bench.processes import free_port
from hil.control.loop import Loop
from hil.control.runner import Runner
from hil.errors import LinkError
from hil.links import crtp
from hil.links.backends import make_backend, mechanism_lag
from hil.links.backends.base import ACCEPTED, FAILED, FOLLOW
from hil.links.backends.crazyflie import Crazyflie
from hil.links.device import Device, UdpPort
from hil.links.mavlink_link import Link
from hil.params import HilParams
from hil.poses.sources.opening import open_source
from hil.rehearsal.fake import VEHICLE_ID, Options
from hil.rehearsal.fake_mocap import MocapParams
from tests.fakes.fake_crazyflie import FakeCrazyflie
from tests.fakes.ports import AnsweringPort
from tests.hil_flight import AutoOperator
from tests.sitl.direct import FlightClock
from visthrow import config
from visthrow.onboard.policy import Policy, find_policy
from visthrow.throws.wire_plant import make


class Desk:
    """Fake and back-end, period by period."""

    def __init__(self, **options):
        self.number, poses = free_port(), free_port()
        over = [
            f'crazyflie.device="udpout:127.0.0.1:{self.number}"',
            f'link.device="udp:127.0.0.1:{poses}"',
        ]
        self.params = config.load(HilParams, config.find("hil", "fake_crazyflie"), over)
        port = AnsweringPort(Device("udp", "127.0.0.1", self.number))
        link = Link(UdpPort(Device("udpout", "127.0.0.1", poses)), *VEHICLE_ID)
        self.fake = FakeCrazyflie(
            make("vision", 0), link, MocapParams(), 0, Options(**options), port=port
        )
        self.backend = make_backend(self.params)

    def turn(self, seconds, command=None, ask=None):
        end, tick = self.fake.plant.time + seconds, 0.0
        while self.fake.plant.time < end - 1e-9:
            now = self.fake.plant.time
            if now >= tick:
                tick = now + 0.02
                if ask is not None:
                    self.backend.ask(ask, now)
                if command is not None:
                    self.backend.send(command, now)
                self.backend.service(now)
            self.fake.step()

    def close(self):
        self.backend.close()
        self.fake.close()


@pytest.fixture
def desk():
    made = []

    def build(**options):
        made.append(Desk(**options))
        return made[-1]

    yield build
    for one in made:
        one.close()


def test_a_whole_throw(desk, tmp_path):
    """Taken, armed, thrown, released and recovered by the runner; the vehicle's poses go to its
    estimator.
    """
    one = desk()
    clock = FlightClock(one.fake)
    source, _, _ = open_source(one.params, tmp_path, clock)
    runner = Runner(
        one.params, Policy.load(find_policy("vision")), one.backend, mechanism_lag(one.params)
    )
    runner.watcher = one.backend.place
    loop = Loop(runner, source, clock, AutoOperator())
    while one.fake.plant.time < 9.0 and one.fake.plant.landing["landing_time"] is None:
        loop.turn(False)
    landing = one.fake.plant.landing["landing_w"]
    source.close()
    assert landing is not None, runner.machine.reason
    assert math.hypot(landing[0] - 2.0, landing[1]) < 0.1
    assert one.backend.release_record.state == ACCEPTED
    assert len(one.fake.placed) > 100
    place = np.array(one.fake.placed[-1][0])
    assert np.linalg.norm(place - one.fake.plant.state["pos_w"]) < 0.1


def test_rates_come_as_they_are_meant(desk):
    """Roll right, nose down and yaw left are positive with us."""
    one = desk()
    one.turn(0.5, (0.0, 0.0, 0.0, 0.0), FOLLOW)
    assert one.backend.status(one.fake.plant.time).mode == FOLLOW
    weight = one.fake.plant.mass[0] * 9.81
    for axis in range(3):
        rates = [0.0, 0.0, 0.0]
        rates[axis] = 1.0
        one.turn(0.06, (weight, *rates))
        thrust, *told = one.fake._target
        assert told == pytest.approx(rates, abs=1e-3)
        assert thrust == pytest.approx(weight, rel=1e-3)
        one.turn(0.1, (weight, 0.0, 0.0, 0.0))


def test_silence_levels_and_then_stops_the_motors(desk):
    one = desk()
    one.turn(0.5, (0.0, 0.0, 0.0, 0.0), FOLLOW)
    one.turn(0.3, (one.fake.plant.mass[0] * 9.81, 0.0, 0.0, 0.0))
    for _ in range(500):
        one.fake.step()
    told = [text for _, text in one.fake.events]
    assert told[:3] == ["armed", "commander: level", "motors off"]


@pytest.mark.parametrize(
    ("answer", "state", "note"),
    [("denied", FAILED, "not known"), ("silent", FAILED, "no final answer")],
)
def test_a_release_that_is_not_answered_well_has_failed(desk, answer, state, note):
    one = desk(answer=answer)
    one.turn(0.5, (0.0, 0.0, 0.0, 0.0), FOLLOW)
    one.backend.release(one.fake.plant.time)
    one.turn(1.0, (one.fake.plant.mass[0] * 9.81, 0.0, 0.0, 0.0))
    assert one.backend.release_record.state == state
    assert note in one.backend.release_record.note


def test_nothing_flies_before_its_set_points_are_rates(desk):
    """A firmware without the parameters: it is never armed, and the note says why."""
    one = desk()
    del one.fake.parameters["flightmode.stabModeRoll"]
    one.turn(1.0, (0.0, 0.0, 0.0, 0.0), FOLLOW)
    assert not one.fake.armed
    assert one.backend.status(one.fake.plant.time).note == "its set-points are being set to rates"


def test_packets_and_devices(monkeypatch):
    assert crtp.unpack(b"") is None
    assert crtp.unpack(bytes(40)) is None
    assert crtp.set_point(1, (1.0, 2.0, 3.0)) == b"\x30" + crtp.SET_POINT.pack(1.0, -2.0, 3.0, 1)
    assert crtp.set_parameter("a.b", 1) == b"\x23\x00a\0b\0\x08\x01"
    with pytest.raises(LinkError, match="is refused"):
        crtp.open_crtp("/bin/sh", False)
    monkeypatch.setitem(sys.modules, "cflib.crtp", None)
    with pytest.raises(LinkError, match="crazyflie"):
        crtp.open_crtp("radio://0/80/2M", False)
    assert Crazyflie.holds is False
