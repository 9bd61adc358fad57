"""The ball below PX4's own vehicle: its laws, and the bridge against a fake of the other side."""

import math

import numpy as np
from numpy.testing import assert_allclose
from pytest import approx, fixture

from bench.processes import free_port
from hil.links.device import Device, UdpPort
from hil.links.mavlink_link import Link
from hil.links.pymav import mav
from hil.rehearsal.bridges.px4_bridge import ORIGIN, Motion, Place, Px4Sih
from hil.rehearsal.fake import VEHICLE_ID, FakeOptions
from hil.rehearsal.fake_command import make_ball
from hil.rehearsal.fake_mocap import FakeMocapParams
from tests.configs import load_run

LEVEL = np.array([0.0, 0.0, 0.0, 1.0])
STILL = np.zeros(3)
LATITUDE, LONGITUDE, ALTITUDE = np.float32([47.397742, 8.545594, 489.4]).astype(float).tolist()
"""SIH's origin by default [deg, deg, m], as its parameters hold it."""


def fly(ball, seconds, place, interval=0.004):
    """Fly a ball below a vehicle whose place is a function of time, known every so often [s]; times
    and places of the ball.
    """
    known, track = ball.time - interval, []
    while ball.time < seconds:
        while known < ball.time + ball.period:
            known += interval
            step = 1e-4
            vel = (place(known + step) - place(known - step)) / (2.0 * step)
            ball.follow(Motion(known, place(known), vel, LEVEL, STILL))
        ball.step(np.zeros(4), False)
        track.append((ball.time, *ball.state["payload_pos_w"]))
    return np.array(track)


def nudged(time):
    """A place that moves aside by 2 cm between two messages, and stays there."""
    return np.array([0.02 * (time > 0.1017), 0.0, 2.0])


def test_a_small_swing_has_the_period_of_a_pendulum_and_halves_as_in_the_simulator():
    """2 pi sqrt(l / g), by the times at which the ball passes below the mount; below the
    simulator's hovering vehicle a swing halves in 1.4 s.
    """
    ball = make_ball("vision", 0)
    track = fly(ball, 6.0, nudged)
    time, off = track[:, 0], track[:, 1] - 0.02
    rises = np.flatnonzero((off[:-1] < 0.0) & (off[1:] >= 0.0))
    crossings = time[rises] - off[rises] * (time[rises + 1] - time[rises]) / (
        off[rises + 1] - off[rises]
    )
    period = 2.0 * math.pi * math.sqrt(ball.length / 9.81)
    assert np.diff(crossings).mean() == approx(period, rel=0.01)
    early, late = (np.abs(off[(time > t) & (time < t + period)]).max() for t in (0.5, 3.3))
    assert late / early == approx(0.25, abs=0.05)
    reach = np.linalg.norm(track[-1, 1:] - [0.02, 0.0, 2.0 + ball.mount_b[2]])
    assert reach <= ball.length * (1.0 + 1e-9)


class OtherSide:
    """PX4's side of the bridge's link: the true state, outputs, parameters; it records the
    requested streams.
    """

    def __init__(self, port):
        self.link = Link(UdpPort(Device("udpout", "127.0.0.1", port)), *VEHICLE_ID)
        self.requested = set()
        self.link.listen(self._hear)

    def _hear(self, message, arrival):
        kind = message.get_type()
        if kind == "COMMAND_LONG" and message.command == mav.MAV_CMD_SET_MESSAGE_INTERVAL:
            self.requested.add(int(message.param1))
        elif kind == "PARAM_REQUEST_READ":
            values = dict(zip(ORIGIN, (LATITUDE, LONGITUDE, ALTITUDE)))
            value = (values[message.param_id], mav.MAV_PARAM_TYPE_REAL32, 1, 0)
            self.link.send(mav.MAVLink_param_value_message(message.param_id.encode(), *value))

    def fly(self, bridge, periods, pos, yaw=0.0, output=lambda n: 2000):
        """Fly a vehicle that stays where it is for some periods, a state ahead of the bridge; PX4's
        clock is its own: 100 s ahead. Yields the number of each period that was flown.
        """
        while bridge._place is None:  # it requests the world's origin after the first message
            self.say(0.0, pos, yaw, output(0))
            bridge.step()
        self.say(100.0, pos, yaw, output(0))
        for n in range(periods):
            self.say(100.0 + 0.005 * (n + 1), pos, yaw, output(n))
            bridge.step()
            yield n

    def say(self, time, pos, yaw, output):
        """Say where the vehicle is, north, east, down of the origin [m], as PX4 cuts it to whole
        units.
        """
        scale = 111_320.0 * math.cos(math.radians(LATITUDE))
        lat, lon = LATITUDE + pos[0] / 111_183.0, LONGITUDE + pos[1] / scale
        quat = [math.cos(0.5 * yaw), 0.0, 0.0, math.sin(0.5 * yaw)]
        where = (int(1e7 * lat), int(1e7 * lon), int(1e3 * (ALTITUDE - pos[2])))
        self.link.send(
            mav.MAVLink_hil_state_quaternion_message(
                int(1e6 * time), quat, 0.0, 0.0, 0.0, *where, 0, 0, 0, 0, 0, 0, 0, 0
            )
        )
        outputs = [1500] * 8 + [output] + [0] * 7
        self.link.send(mav.MAVLink_servo_output_raw_message(int(1e6 * time) % 2**32, 0, *outputs))
        self.link.pump(lambda: time)


@fixture
def bridge():
    port, params = free_port(), load_run("px4").px4
    autopilot = Link(UdpPort(Device("udp", "127.0.0.1", port)), 254, 190)
    poses = Link(UdpPort(Device("udpout", "127.0.0.1", free_port())), *VEHICLE_ID)
    made = Px4Sih(
        make_ball("vision", 0), poses, FakeMocapParams(), 0, FakeOptions(), params, autopilot
    )
    made.other = OtherSide(port)
    yield made
    made.close()


def test_the_bridge_hears_places_and_the_mechanism(bridge):
    opens = bridge.params.servo_open_us
    for _ in bridge.other.fly(bridge, 400, (1.0, 2.0, -3.0), 0.3, lambda n: [2000, opens][n > 300]):
        pass
    now = bridge.plant.state
    assert_allclose(now["pos_w"], [1.0, -2.0, 3.0], atol=0.01)
    assert_allclose(now["quat_wb"], [0.0, 0.0, -math.sin(0.15), math.cos(0.15)], atol=1e-6)
    assert bridge.other.requested >= {
        mav.MAVLINK_MSG_ID_HIL_STATE_QUATERNION,
        mav.MAVLINK_MSG_ID_SERVO_OUTPUT_RAW,
    }
    report = bridge.report()
    assert report["releases"] == 1
    assert 1.5 < report["separation_time"] < 1.6


def test_the_ball_is_hung_where_the_vehicle_is_first_heard(bridge):
    """Also below one that hovers elsewhere by then: it hangs still from the first pose on."""
    for _ in bridge.other.fly(bridge, 200, (5.0, -4.0, -1.333)):
        if bridge.heard_of > 1:
            off = bridge.plant.state["payload_pos_w"] - bridge.plant.state["pos_w"]
            assert np.hypot(off[0], off[1]) < 0.02
    assert bridge.heard_of > 100


def test_the_place_is_smooth_though_px4_cuts_it_to_centimetres():
    """Latitude comes in steps of 1.1 cm: beside a velocity the place follows within 8 mm, without
    steps.
    """
    place, step = Place(LATITUDE, LONGITUDE, ALTITUDE), 0.004
    track = []
    for n in range(500):
        north = 1.5 * n * step
        message = mav.MAVLink_hil_state_quaternion_message(
            0,
            [1.0, 0.0, 0.0, 0.0],
            *(0.0, 0.0, 0.0),
            int(1e7 * (LATITUDE + north / 111_183.0)),
            int(1e7 * LONGITUDE),
            int(1e3 * ALTITUDE),
            *(150, 0, 0, 0, 0, 0, 0, 0),
        )
        track.append(place.update(n * step, message)[0][0] - north)
    assert np.abs(track).max() < 0.012
    assert np.abs(np.diff(track)).max() < 2e-4


def test_an_output_that_was_open_before_releases_nothing(bridge):
    """After a throw PX4's gripper stays open until a command closes it; then it may open again."""
    opens = bridge.params.servo_open_us

    def output(n):
        return 2000 if 100 <= n < 200 else opens

    for n in bridge.other.fly(bridge, 300, (0.0, 0.0, -1.333), output=output):
        if n == 150:
            assert bridge.report()["releases"] == 0
    assert bridge.report()["releases"] == 1
