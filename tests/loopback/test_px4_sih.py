"""The ball below PX4's own vehicle: its laws, and the bridge against a fake of the other side."""

import math

import numpy as np
import pytest

from bench.processes import free_port
from hil.links.device import Device, UdpPort
from hil.links.mavlink_link import Link
from hil.links.pymav import mav
from hil.params import HilParams
from hil.rehearsal.bridges.px4_bridge import Px4Sih
from hil.rehearsal.fake import VEHICLE_ID, Options
from hil.rehearsal.fake_command import make_ball
from hil.rehearsal.fake_mocap import MocapParams
from visthrow import config

LEVEL = np.array([0.0, 0.0, 0.0, 1.0])
STILL = np.zeros(3)


def test_a_small_swing_has_the_period_of_a_pendulum():
    """2 pi sqrt(l / g), by the times at which the ball passes below the mount."""
    ball = make_ball("vision", 0)
    ball.follow(np.array([0.0, 0.0, 2.0]), STILL, LEVEL, STILL)
    ball.step(np.zeros(4), False)
    ball.follow(
        np.array([0.02, 0.0, 2.0]), STILL, LEVEL, STILL
    )  # the mount jumps: the ball hangs beside it now
    crossings, before = [], None
    for _ in range(1200):
        ball.step(np.zeros(4), False)
        off = ball.state["payload_pos_w"][0] - 0.02
        if before is not None and before < 0.0 <= off:
            crossings.append(ball.time - ball.period * off / (off - before))
        before = off
    assert np.diff(crossings).mean() == pytest.approx(
        2.0 * math.pi * math.sqrt(ball.length / 9.81), rel=0.01
    )
    assert np.linalg.norm(
        ball.state["payload_pos_w"] - [0.02, 0.0, 2.0 + ball.mount_b[2]]
    ) <= ball.length * (1.0 + 1e-9)


def test_a_release_at_a_steady_speed_falls_by_the_parabola():
    """The ball leaves with the vehicle's speed, and lands where g takes it."""
    ball, speed = make_ball("vision", 0), np.array([1.0, 0.5, 0.0])
    place = np.array([0.0, 0.0, 2.0])
    for n in range(1600):
        ball.follow(place + n * ball.period * speed, speed, LEVEL, STILL)
        ball.step(np.zeros(4), n * ball.period > 7.0)
    found, height = ball.landing, 2.0 + ball.mount_b[2] - ball.length - ball.ground
    assert found["landing_time"] - found["separation_time"] == pytest.approx(
        math.sqrt(2.0 * height / 9.81), abs=0.02
    )
    assert not ball.attached


class OtherSide:
    """PX4's side of the bridge's own link: position, attitude and outputs; it hears which streams
    are asked for.
    """

    def __init__(self, port):
        self.link = Link(UdpPort(Device("udpout", "127.0.0.1", port)), *VEHICLE_ID)
        self.asked = set()
        self.link.listen(self._hear)

    def _hear(self, message, arrival):
        if (
            message.get_type() == "COMMAND_LONG"
            and message.command == mav.MAV_CMD_SET_MESSAGE_INTERVAL
        ):
            self.asked.add(int(message.param1))

    def say(self, time, pos, yaw, output):
        ms = int(1e3 * time)
        self.link.send(mav.MAVLink_local_position_ned_message(ms, *pos, 0.0, 0.0, 0.0))
        quat = (math.cos(0.5 * yaw), 0.0, 0.0, math.sin(0.5 * yaw))
        self.link.send(mav.MAVLink_attitude_quaternion_message(ms, *quat, 0.0, 0.0, 0.0))
        outputs = [1500] * 8 + [output] + [0] * 7
        self.link.send(mav.MAVLink_servo_output_raw_message(int(1e6 * time) % 2**32, 0, *outputs))
        self.link.pump(lambda: time)


def test_the_bridge_hears_places_and_the_mechanism():
    port, params = free_port(), config.load(HilParams, config.find("hil", "px4")).px4
    own = Link(UdpPort(Device("udp", "127.0.0.1", port)), 254, 190)
    poses = Link(UdpPort(Device("udpout", "127.0.0.1", free_port())), *VEHICLE_ID)
    bridge = Px4Sih(make_ball("vision", 0), poses, MocapParams(), 0, Options(), params, own)
    px4 = OtherSide(port)
    for n in range(400):
        px4.say(0.005 * n, (1.0, 2.0, -3.0), 0.3, 2000 if n < 300 else params.servo_open_us)
        bridge.step()
    now = bridge.plant.state
    np.testing.assert_allclose(now["pos_w"], [1.0, -2.0, 3.0], atol=1e-6)
    np.testing.assert_allclose(
        now["quat_wb"], [0.0, 0.0, -math.sin(0.15), math.cos(0.15)], atol=1e-6
    )
    assert px4.asked >= {
        mav.MAVLINK_MSG_ID_LOCAL_POSITION_NED,
        mav.MAVLINK_MSG_ID_ATTITUDE_QUATERNION,
    }
    report = bridge.report()
    assert report["releases"] == 1
    assert 1.5 < report["separation_time"] < 1.6
    bridge.close()
