"""Sources: senders distinguished, pairs, .tlog and CSV read as the live link does, wrong files
reported.
"""

import math
import threading

import numpy as np
from pytest import approx, mark, raises

from hil.errors import SourceError
from hil.links.mavlink_link import Link
from hil.links.pymav import mav
from hil.links.roster import Party, Roster
from hil.links.writer import TlogWriter
from hil.poses.pose import Pose
from hil.poses.sources.mavlink import BodyIds, MavlinkDecoder, MavlinkSource
from hil.poses.sources.player import read_table, read_tlog
from hil.poses.sources.pose_source import RecordedSource
from tests.configs import load_run
from tests.loopback.wire import pass_wire, pipe
from visthrow.common.errors import ConfigError
from visthrow.logs.flightlog import Channel, FlightLog

BODIES = (BodyIds("vehicle", "ATT_POS_MOCAP", 1, 0), BodyIds("payload", "ODOMETRY", 2, 1))


def mocap(time_us=1_000_000, x=1.0):
    return mav.MAVLink_att_pos_mocap_message(time_us, [1.0, 0.0, 0.0, 0.0], x, 2.0, 3.0)


def odometry(frame=mav.MAV_FRAME_LOCAL_FRD, quality=0):
    quat, none = [1.0, 0.0, 0.0, 0.0], [0.0] * 21
    rest = (*[0.0] * 6, none, none, 0, 0, quality)
    return mav.MAVLink_odometry_message(7, frame, 12, 1.0, 2.0, 3.0, quat, *rest)


def local_position(time_ms=1000):
    return mav.MAVLink_local_position_ned_message(time_ms, 1.0, 2.0, 3.0, 4.0, 5.0, 6.0)


def test_bodies_are_distinguished_by_their_senders():
    decoder = MavlinkDecoder(BODIES)
    assert decoder.feed(pass_wire(mocap(), 1, 9), 0.0).body == "vehicle"
    assert decoder.feed(pass_wire(mocap(), 2, 1), 0.0) is None
    assert decoder.feed(pass_wire(odometry(), 2, 1), 0.0).body == "payload"
    assert decoder.feed(pass_wire(odometry(), 2, 2), 0.0) is None
    assert decoder.feed(pass_wire(mav.MAVLink_heartbeat_message(2, 3, 0, 0, 0, 3)), 0.0) is None


def test_a_local_position_takes_the_attitude_of_its_sender():
    decoder = MavlinkDecoder((BodyIds("vehicle", "LOCAL_POSITION_NED", 1, 1),))
    local = pass_wire(local_position())
    assert decoder.feed(local, 0.0) is None, "no attitude yet"
    attitude = mav.MAVLink_attitude_quaternion_message(990, 1.0, 0.0, 0.0, 0.0, 0.25, 0.5, 0.75)
    decoder.feed(pass_wire(attitude, 3, 1), 0.0)
    assert decoder.feed(local, 0.0) is None, "another sender's"
    decoder.feed(pass_wire(attitude), 0.0)
    pose = decoder.feed(local, 0.5)
    assert pose == Pose(
        1.0,
        0.5,
        "vehicle",
        (1.0, 2.0, 3.0),
        (1.0, 0.0, 0.0, 0.0),
        (4.0, 5.0, 6.0),
        (0.25, 0.5, 0.75),
    )
    assert decoder.feed(pass_wire(local_position(1100)), 0.0) is None, "too old an attitude"


def test_a_local_position_takes_angles_as_well():
    """ArduPilot streams ATTITUDE, and ATTITUDE_QUATERNION only on request."""
    decoder = MavlinkDecoder((BodyIds("vehicle", "LOCAL_POSITION_NED", 1, 1),))
    decoder.feed(
        pass_wire(mav.MAVLink_attitude_message(990, 0.0, 0.0, math.pi / 2, 0.1, 0.2, 0.3)), 0.0
    )
    pose = decoder.feed(pass_wire(local_position()), 0.5)
    assert pose.quat == approx((math.sqrt(0.5), 0.0, 0.0, math.sqrt(0.5)))
    assert pose.rate == approx((0.1, 0.2, 0.3))


def test_an_estimate_that_failed_is_no_pose():
    decoder = MavlinkDecoder((BodyIds("vehicle", "ODOMETRY", 1, 1),))
    valid = [decoder.feed(pass_wire(odometry(quality=q)), 0.0).valid for q in (-1, 0, 1, 100)]
    assert valid == [False, True, True, True]


@mark.parametrize("live", [False, True])
def test_what_is_no_pose_is_counted_and_says_why(tmp_path, live):
    """In a recording and on a link: an ODOMETRY in other frames, a position without an attitude."""
    senders = (
        BodyIds("vehicle", "ODOMETRY", 1, 1),
        BodyIds("payload", "LOCAL_POSITION_NED", 1, 25),
    )
    packed = [
        (odometry(mav.MAV_FRAME_LOCAL_FLU), 1),
        (local_position(), 25),
    ]
    if live:
        here, far_end = pipe()
        parties = [Party(b.body, b.system, b.component, frozenset({b.message})) for b in senders]
        source = MavlinkSource(Link(here, roster=Roster(parties)), senders, lambda: 1.0)
        for message, component in packed:
            far_end.write(message.pack(mav.MAVLink(None, 1, component)))
        assert source.poll(1.0) == []
        (roster,) = source.rosters
    else:
        roster = Roster()
        writer = TlogWriter(tmp_path / "x.tlog")
        for message, component in packed:
            writer.write(pass_wire(message, 1, component))
        writer.close()
        assert read_tlog(tmp_path / "x.tlog", senders, roster) == []
    reasons = {entry.why: count for entry, count in roster.received.items() if entry.why}
    assert reasons == {
        "frame LOCAL_FLU is not taken; expected LOCAL_NED or LOCAL_FRD": 1,
        "no ATTITUDE_QUATERNION or ATTITUDE within 50 ms of it": 1,
    }
    with raises(SourceError, match=r"1 ODOMETRY of system 1.*frame LOCAL_FLU is not taken"):
        RecordedSource([], roster)


def test_senders_that_clash_are_refused():
    with raises(SourceError, match="no two bodies"):
        MavlinkDecoder((BodyIds("vehicle", "ODOMETRY", 1, 0), BodyIds("payload", "ODOMETRY", 1, 2)))
    with raises(SourceError, match="at least one"):
        MavlinkDecoder(())
    with raises(ConfigError, match="expected 1 to 255"):
        BodyIds("vehicle", "ODOMETRY", 0, 0)


def test_a_slow_disk_holds_up_no_message(tmp_path, monkeypatch):
    monkeypatch.setattr("hil.links.writer.MOST_WAITING", 30)
    path, turning, message = tmp_path / "a.tlog", threading.Event(), pass_wire(mocap(0, 0.0))
    writer = TlogWriter(path)
    file = writer._file

    class Disk:
        close, flush = file.close, file.flush

        def write(self, data: bytes) -> int:
            turning.wait(60.0)
            return file.write(data)

    writer._file = Disk()
    for _ in range(200):  # from here on one of them is with the disk at most
        writer.write(message, 1.0)
    assert 200 - 31 <= writer.failed <= 200 - 30
    assert not path.stat().st_size
    turning.set()
    writer.close()
    assert len(read_tlog(path, BODIES)) == 200 - writer.failed


def test_a_tlog_gives_what_the_link_gave_past_damage(tmp_path):
    path = tmp_path / "a.tlog"
    writer, decoder, live = TlogWriter(path), MavlinkDecoder(BODIES), []
    for i in range(20):
        message = pass_wire(mocap(1000 * i, 0.1 * i))
        writer.write(message, 100.0 + 0.01 * i)
        live.append(decoder.feed(message, 0.01 * i))
    writer.close()
    read = read_tlog(path, BODIES)
    assert [(p.stamp, p.pos, p.quat) for p in read] == [(p.stamp, p.pos, p.quat) for p in live]
    np.testing.assert_allclose([p.arrival for p in read], [p.arrival for p in live], atol=2e-6)
    data = path.read_bytes()
    length = len(data) // 20
    path.write_bytes(data[: 5 * length + 11] + b"rubbish" + data[7 * length : -9])
    assert len(read_tlog(path, BODIES)) == 17


def test_files_that_are_no_tlog(tmp_path):
    path = tmp_path / "x.tlog"
    with raises(SourceError, match="cannot be read"):
        read_tlog(path, BODIES)
    path.write_bytes(b"\x00" * 500)
    with raises(SourceError, match="500 bytes without a single"):
        read_tlog(path, BODIES)


CSV = "t,x,y,z,roll,pitch,yaw\n1000,1,2,3,0,0,90\n1010,1.5,2,3,0,0,90\n\n1020,,2,3,0,0,90\n"


def test_a_flight_log_is_a_source_without_a_mapping(tmp_path):
    """Channels of other clocks are those at or before the position, unless they are old."""
    time = 0.01 * np.arange(20)
    place = np.column_stack([time, 0 * time, 1 + 0 * time])
    turned = np.tile([0.0, 0.0, 0.0, 1.0], (8, 1))
    turned[3:, 2:] = math.sqrt(0.5)
    valid = np.arange(20) != 5
    log = FlightLog(
        {
            "pos_w": Channel(time, place, "m", "world", valid),
            "quat_wb": Channel(time[:16:2] + 0.004, turned, "1", "world"),
            "payload_pos_w": Channel(time + 0.003, place - [0, 0, 0.4], "m", "world"),
        }
    )
    log.save(tmp_path / "a.npz")
    poses = read_table(tmp_path / "a.npz", None)
    vehicle = [pose for pose in poses if pose.body == "vehicle"]
    assert [math.isnan(pose.pos[0]) for pose in vehicle] == (~valid).tolist()
    assert vehicle[0].quat is None, "no attitude yet"
    assert [pose.quat[2] > 0.5 for pose in vehicle[1:]] == [i > 6 for i in range(1, 20)]
    assert vehicle[19].quat is not None, "46 ms old"
    assert [pose.arrival for pose in poses if pose.body == "payload"] == approx(time + 0.003)
    FlightLog({"rate_b": Channel(time, place, "rad/s", "body")}).save(tmp_path / "b.npz")
    with raises(SourceError, match="no row with a position of a body"):
        read_table(tmp_path / "b.npz", None)


def test_csv_without_mapping(tmp_path):
    path = tmp_path / "a.csv"
    path.write_text(CSV)
    with raises(SourceError, match=r"columns t, x, y, z, roll, pitch, yaw, .*it needs a mapping"):
        read_table(path, None)


@mark.parametrize(
    ("settings", "message"),
    [
        (
            ('source.columns=[{name="pos_w", columns=["x", "y", "z"], unit="m"}]',),
            "a table needs both a time and columns",
        ),
        (
            (
                'source.columns=[{name="pos_w", columns=["x", "y", "z"], unit="deg"}]',
                'source.time={column="t"}',
            ),
            "of the kind 'rad'",
        ),
        (
            (
                (
                    'source.columns=[{name="quat_wb", columns=["r", "p", "y"], unit="deg",'
                    ' kind="euler"}]'
                ),
                'source.time={column="t"}',
            ),
            "kind csv writes 'xyzw'",
        ),
    ],
)
def test_wrong_mappings(settings, message):
    with raises(ConfigError, match=message):
        load_run("dry_run", ("source.kind=csv", "source.file=a.csv", *settings))


def test_recorded_poses_come_when_their_time_has_come():
    source = RecordedSource(Pose(0.0, t, "vehicle", (t, 0.0, 0.0)) for t in (0.3, 0.1, 0.2))
    assert source.start == 0.1
    assert [pose.arrival for pose in source.poll(0.25)] == [0.1, 0.2]
    assert not source.ended
    assert source.poll(0.25) == []
    assert len(source.poll(1.0)) == 1
    assert source.ended
    with raises(SourceError, match="holds no pose"):
        RecordedSource([])
