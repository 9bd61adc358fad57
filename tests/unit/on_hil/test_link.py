"""The link: no bytes make it raise, device strings are refused, units and orders are MAVLink's, the
.tlog reads back.
"""

import math
import os
import socket
import time
from pathlib import Path

import numpy as np
from numpy.testing import assert_allclose
from pytest import mark, raises
from scipy.spatial.transform import Rotation

from bench.processes import free_port
from hil.errors import LinkError
from hil.links.device import check_device, open_port
from hil.links.mavlink_link import Link, attitude_target, pose_from_message, quaternion_from_euler
from hil.links.pymav import Parser, mav
from hil.links.roster import Roster
from hil.links.writer import TlogWriter
from hil.poses.sources.open_source import open_source
from tests.configs import load_run
from tests.fuzz import EACH, SEEDS, any_message, mutate, noise


def pack(message) -> bytes:
    return message.pack(mav.MAVLink(None, 1, 1))


def odometry(frame=20, child=12, vel=(1.0, 2.0, 3.0), q=(1.0, 0.0, 0.0, 0.0), rate=(0.1, 0.2, 0.3)):
    return mav.MAVLink_odometry_message(
        2_000_000, frame, child, 1.0, 2.0, -3.0, list(q), *vel, *rate, [0.0] * 21, [0.0] * 21, 7
    )


MESSAGES = [
    mav.MAVLink_att_pos_mocap_message(5, [1.0, 0.0, 0.0, 0.0], 1.0, 2.0, 3.0),
    mav.MAVLink_vision_position_estimate_message(5, 1.0, 2.0, 3.0, 0.1, 0.2, 0.3),
    odometry(),
    mav.MAVLink_heartbeat_message(2, 3, 128, 4, 4, 3),
    mav.MAVLink_command_ack_message(211, 0),
    mav.MAVLink_timesync_message(0, 123456),
    mav.MAVLink_statustext_message(4, b"text"),
    mav.MAVLink_servo_output_raw_message(5, 0, *range(1000, 1008)),
]


POSES = tuple(message.id for message in MESSAGES[:3])


def fuzz(count: int, seed: int) -> None:
    """Noise and spoiled messages, half of these with a right checksum over any content: they reach
    the fields of poses.
    """
    rng = np.random.default_rng(seed)
    good, whole, stream = [pack(message) for message in MESSAGES], Parser(), Parser()
    parsed = 0
    for i in range(count):
        if rng.random() < 0.3:
            data = noise(rng)
        else:
            data = any_message(rng, POSES) if i % 2 else mutate(rng, good)
        for message in whole.parse(data) + stream.parse(data, whole=False):
            pose_from_message(message, "vehicle", 0.0)
            parsed += 1
    assert parsed > count // 10, "some must be messages still"
    assert whole.errors > count // 10
    assert whole.parse(good[0]), "and the parser works on"


def test_no_bytes_make_the_parser_raise():
    fuzz(20_000, 0)


def test_a_cut_datagram_does_not_spoil_the_next():
    parser, good = Parser(), pack(MESSAGES[0])
    assert parser.parse(good[:20]) == []
    assert [m.get_type() for m in parser.parse(good)] == ["ATT_POS_MOCAP"]
    assert [m.get_type() for m in parser.parse(good + good)] == ["ATT_POS_MOCAP"] * 2


def test_a_stream_is_put_together():
    parser, good = Parser(), pack(MESSAGES[0])
    assert parser.parse(good[:20], whole=False) == []
    assert len(parser.parse(good[20:], whole=False)) == 1


def test_messages_are_of_version_2():
    assert pack(MESSAGES[0])[0] == mav.PROTOCOL_MARKER_V2
    assert os.environ["MAVLINK20"] == "1"


@mark.parametrize(
    "text",
    [
        "/bin/ls",
        "firmware.elf",
        "udp:/bin/sh:1",
        "tcp:127.0.0.1:5760;x.elf",
        "serial:/bin/bash:115200",
        "./a.elf",
        "serial:/dev/../bin/sh:9600",
        "udp:example.org:14550",
        "",
        "udp:127.0.0.1",
        "udp:127.0.0.1:70000",
        "udp:1.2.3:5",
        "udp:127.0.0.1:14550\n",
        "mcast:",
        "serial:/dev/ttyS0",
        "udp:127.0.0.1:0",
    ],
)
def test_other_device_strings_are_refused(text):
    with raises(LinkError, match=r"refused|numeric address|port"):
        check_device(text, remote=True)


def test_loopback_only_unless_configured_otherwise():
    with raises(LinkError, match="is on another machine"):
        check_device("udp:0.0.0.0:14550")
    assert check_device("udp:192.168.1.2:14550", remote=True).host == "192.168.1.2"
    assert check_device("udpout:[::1]:14550").host == "::1"
    assert check_device("serial:/dev/ttyACM0:921600").port == 921600
    with raises(LinkError, match="cannot connect"):
        open_port(check_device("tcp:127.0.0.1:9"))


def test_a_port_that_is_taken_says_who_may_have_it_and_what_names_another():
    number = free_port()
    first = open_port(check_device(f"udp:127.0.0.1:{number}"))
    params = load_run("fake", [f"link.device=udp:127.0.0.1:{number}"])
    with raises(LinkError) as caught:
        open_source(params, Path("unused"), time.monotonic)
    first.close()
    for words in (
        "another program has it",
        f"`ss -ulnp 'sport = :{number}'` shows which",
        "--set link.device=udp:127.0.0.1:PORT",
        "hil fake --device udpout:127.0.0.1:PORT",
    ):
        assert words in str(caught.value)
    with raises(LinkError, match="no such address on this machine"):
        open_port(check_device("udp:192.0.2.1:14550", remote=True))  # of the range for examples


def test_what_the_fields_mean():
    pose = pose_from_message(MESSAGES[1], "vehicle", 4.0)
    assert (pose.stamp, pose.arrival, pose.pos, pose.reset) == (5e-6, 4.0, (1.0, 2.0, 3.0), 0)
    w, x, y, z = pose.quat
    angles = Rotation.from_quat([x, y, z, w]).as_euler("ZYX")
    assert_allclose(angles, (0.3, 0.2, 0.1), atol=1e-12)
    assert all(map(math.isnan, quaternion_from_euler(math.inf, 0.0, 0.0)))
    half = math.sqrt(0.5)
    east = pose_from_message(
        odometry(q=(half, 0.0, 0.0, half)), "payload", 0.0
    )  # facing east: forward is east
    assert_allclose(east.vel, (-2.0, 1.0, 3.0), atol=1e-12)
    assert (east.rate, east.reset, east.stamp, east.body) == ((0.1, 0.2, 0.3), 7, 2.0, "payload")
    assert pose_from_message(odometry(child=20), "vehicle", 0.0).vel == (1.0, 2.0, 3.0)
    assert pose_from_message(odometry(vel=(math.nan, 0.0, 0.0)), "vehicle", 0.0).vel is None
    for none in (math.nan, 0.0):  # what turns the velocity is not known, so neither is the velocity
        assert pose_from_message(odometry(q=(none,) * 4), "payload", 0.0).vel is None
        message = odometry(child=20, q=(none,) * 4)
        assert pose_from_message(message, "payload", 0.0).vel == (1.0, 2.0, 3.0)
    assert pose_from_message(odometry(frame=0), "vehicle", 0.0) is None
    assert pose_from_message(MESSAGES[3], "vehicle", 0.0) is None


def test_the_command_on_the_wire():
    sent = attitude_target(12.3456, (1, 2), 0.5, (1.0, -2.0, 3.0))
    (got,) = Parser().parse(pack(sent))
    assert (got.target_system, got.target_component, got.type_mask, got.q) == (
        1,
        2,
        128,
        [1.0, 0.0, 0.0, 0.0],
    )
    assert (got.body_roll_rate, got.body_pitch_rate, got.body_yaw_rate, got.thrust) == (
        1.0,
        -2.0,
        3.0,
        0.5,
    )
    assert got.time_boot_ms == 12345


def test_both_ways_over_loopback_and_the_tlog_reads_back(tmp_path):
    number = free_port()
    ours = Link(
        open_port(check_device(f"udp:127.0.0.1:{number}")), tlog=TlogWriter(tmp_path / "link.tlog")
    )
    peer = Link(open_port(check_device(f"udpout:127.0.0.1:{number}")), 1, 1)
    heard, answers = [], []
    ours.listen(lambda message, arrival: heard.append((message.get_type(), arrival)))
    peer.listen(lambda message, arrival: answers.append(message.get_type()))
    assert not ours.send(MESSAGES[3]), "no peer is known yet"
    assert peer.send(MESSAGES[0])
    with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as stranger:
        ours.pump(lambda: 1.5)
        stranger.sendto(pack(MESSAGES[2]), ("127.0.0.1", number))
        ours.pump(lambda: 2.5)
    assert heard == [("ATT_POS_MOCAP", 1.5)], "a stranger is not heard"
    assert ours.send(attitude_target(0.0, (1, 1), 0.5, (0.0, 0.0, 0.0)))
    peer.pump(lambda: 0.0)
    assert answers == ["SET_ATTITUDE_TARGET"]
    assert (ours.sent, ours.dropped, ours.received) == (1, 1, 1)
    ours.close()
    peer.close()
    from pymavlink import mavutil

    reader = mavutil.mavlink_connection(str(tmp_path / "link.tlog"), dialect="ardupilotmega")
    assert [reader.recv_msg().get_type() for _ in range(2)] == [
        "ATT_POS_MOCAP",
        "SET_ATTITUDE_TARGET",
    ]
    reader.close()


def test_a_device_that_names_its_peer_hears_nobody_else():
    number, messages = free_port(), []
    ours = Link(
        open_port(check_device(f"udpout:127.0.0.1:{number}")), roster=Roster(tell=messages.append)
    )
    peer = Link(open_port(check_device(f"udp:127.0.0.1:{number}")), 1, 1)
    heard = []
    ours.listen(lambda message, arrival: heard.append(message.get_type()))
    assert ours.send(MESSAGES[3])
    peer.pump(lambda: 0.0)
    (address,) = peer.roster.at.values()
    with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as stranger:
        stranger.sendto(pack(MESSAGES[2]), address)
        peer.send(MESSAGES[0])
        ours.pump(lambda: 0.0)
        assert heard == ["ATT_POS_MOCAP"]
        assert messages == [
            f"refused: datagram from 127.0.0.1:{stranger.getsockname()[1]}: the link's device is"
            f" 127.0.0.1:{number}"
        ]
    ours.close()
    peer.close()


def test_a_message_that_cannot_be_packed_is_not_sent(tmp_path):
    link = Link(open_port(check_device(f"udpout:127.0.0.1:{free_port()}")))
    assert not link.send(attitude_target(0.0, (1, 1), None, (0.0, 0.0, 0.0)))
    assert link.dropped == 1
    link.close()


@mark.slow
@mark.parametrize("seed", SEEDS)
def test_a_million_byte_strings(seed):
    fuzz(EACH, seed)
