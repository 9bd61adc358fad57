"""Autopilot logs as sources: files written byte by byte, each message that carries a pose, damage
and wrong files.
"""

import math

from pytest import approx, importorskip, raises

from hil.control.recording.record import lines
from hil.errors import SourceError
from hil.poses.sources.player import LogBody, read_autopilot
from tests import logfiles as files

VEHICLE = (LogBody("vehicle", "VISP"),)


def read_bin(path, bodies):
    return read_autopilot(path, bodies, "bin")


def read_ulg(path, bodies):
    return read_autopilot(path, bodies, "ulg")


QUARTER = math.sqrt(0.5)
YAWED = (QUARTER, 0.0, 0.0, QUARTER)
"""A quarter turn about down, wxyz."""


def vision(i, reset=0):
    return (
        "VISP",
        (
            1_000_000 + 20_000 * i,
            5_000_000,
            990 + 20 * i,
            0.1 * i,
            2.0,
            -1.5,
            0.0,
            0.0,
            90.0,
            0,
            0,
            reset,
            0,
            100,
        ),
    )


def test_vision_poses_of_a_bin_with_separate_stamps(tmp_path):
    path = tmp_path / "a.BIN"
    files.write_bin(path, {"VISP": files.VISP}, [vision(i, int(i >= 3)) for i in range(5)])
    poses = read_bin(path, VEHICLE)
    assert [pose.stamp for pose in poses] == approx([0.99, 1.01, 1.03, 1.05, 1.07])
    assert [pose.arrival for pose in poses] == approx([0.0, 0.02, 0.04, 0.06, 0.08])
    assert poses[2].pos == approx((0.2, 2.0, -1.5))
    assert poses[2].quat == approx(YAWED)
    assert [pose.reset for pose in poses] == [0, 0, 0, 1, 1]
    files.write_bin(
        path,
        {"VISP": files.VISP_OLD},
        [(name, values[:-1]) for name, values in (vision(i) for i in range(2))],
    )
    assert read_bin(path, VEHICLE)[1].quat == approx(YAWED), "names of before 4.3"


def test_an_estimate_is_that_of_one_core(tmp_path):
    path = tmp_path / "a.BIN"
    rows = [
        (
            "XKF1",
            (
                1000 * i,
                core,
                0.0,
                0.0,
                90.0,
                1.0,
                2.0,
                3.0,
                0.0,
                0.5 + core,
                0.25,
                -1.0,
                0,
                0,
                0,
                0,
            ),
        )
        for i in range(4)
        for core in (0, 1)
    ]
    files.write_bin(path, {"XKF1": files.XKF1}, rows)
    poses = read_bin(path, (LogBody("vehicle", "XKF1", instance=1),))
    assert len(poses) == 4
    assert (poses[0].pos, poses[0].vel) == ((1.5, 0.25, -1.0), (1.0, 2.0, 3.0))
    assert poses[0].quat == approx(YAWED)
    with raises(SourceError, match=r"XKF1 \(instance 2\) holds no pose"):
        read_bin(path, (LogBody("vehicle", "XKF1", instance=2),))
    with raises(SourceError, match="no VISP in this log; of the messages with poses it has: XKF1"):
        read_bin(path, VEHICLE)
    with raises(SourceError, match="'ATT' of the vehicle carries no pose; known: EKF1, NKF1, POS"):
        read_bin(path, (LogBody("vehicle", "ATT"),))


def test_a_place_on_the_globe_becomes_metres_from_the_origin(tmp_path):
    path = tmp_path / "a.BIN"
    metre = math.degrees(1.0 / 6378100.0)
    rows = [
        ("POS", (900_000, 47.0, 8.0, 500.0, 1.0, 1.5)),  # before any attitude: no pose
        ("ORGN", (950_000, 1, 46.0, 8.0, 400.0)),  # home is not the origin
        ("ORGN", (960_000, 0, 47.0, 8.0, 498.5)),
        ("ATT", (990_000, 0.0, 0.0, 0.0, 0.0, 0.0, 90.0)),
        (
            "POS",
            (
                1_000_000,
                47.0 + 3 * metre,
                8.0 + 2 * metre / math.cos(math.radians(47.0)),
                500.0,
                1.0,
                1.5,
            ),
        ),
        ("POS", (1_200_000, 47.0, 8.0, 500.0, 1.0, 1.5)),  # the attitude is too old
    ]
    files.write_bin(path, {"POS": files.POS, "ATT": files.ATT, "ORGN": files.ORGN}, rows)
    (pose,) = read_bin(path, (LogBody("vehicle", "POS"),))
    assert pose.pos == approx((3.0, 2.0, -1.5), abs=0.02), "1e-7 deg are 11 mm"
    assert pose.quat == approx(YAWED)


def test_loggers_of_two_bodies_are_joined_by_a_stated_offset(tmp_path):
    one, two = tmp_path / "a.BIN", tmp_path / "b.BIN"
    for path in (one, two):
        files.write_bin(path, {"VISP": files.VISP}, [vision(i) for i in range(3)])
    bodies = (
        LogBody("vehicle", "VISP"),
        LogBody("payload", "VISP", file=str(two), time_offset=-0.5),
    )
    poses = read_bin(one, bodies)
    assert {p.body: round(p.arrival, 6) for p in reversed(poses)} == {
        "payload": 0.0,
        "vehicle": 0.5,
    }


ODOMETRY = [
    "uint64_t timestamp",
    "uint64_t timestamp_sample",
    "float[3] position",
    "float[4] q",
    "float[3] velocity",
    "float[3] angular_velocity",
    "uint8_t velocity_frame",
    "uint8_t reset_counter",
]
NAN = math.nan


def odometry(i, velocity=(1.0, 0.0, 0.0), frame=3, quat=YAWED):
    stamp = 1_000_000 + 10_000 * i
    return (stamp + 4_000, stamp, 0.5 * i, 2.0, -1.0, *quat, *velocity, 0.1, 0.2, 0.3, frame, 7)


def test_external_poses_of_a_ulg(tmp_path):
    importorskip("pyulog")
    path = tmp_path / "a.ulg"
    rows = [
        odometry(0),
        odometry(1, frame=1),
        odometry(2, (NAN,) * 3),
        odometry(3, quat=(NAN,) * 4),
    ]
    files.write_ulg(path, {("vehicle_visual_odometry", 0): (ODOMETRY, rows)})
    poses = read_ulg(path, (LogBody("vehicle", "vehicle_visual_odometry"),))
    assert [pose.stamp for pose in poses] == approx([1.0, 1.01, 1.02, 1.03])
    assert [pose.arrival for pose in poses] == approx([0.0, 0.01, 0.02, 0.03])
    assert poses[1].pos == approx((0.5, 2.0, -1.0))
    assert poses[0].quat == approx(YAWED, abs=1e-6)
    assert poses[0].vel == approx((0.0, 1.0, 0.0), abs=1e-6), "of the body, turned into the world"
    assert poses[1].vel == approx((1.0, 0.0, 0.0)), "of the world already"
    assert (poses[2].vel, poses[3].quat) == (None, None), "NaN is PX4's word for unknown"
    assert poses[0].rate == approx((0.1, 0.2, 0.3))
    assert poses[0].reset == 7


def test_the_estimate_of_a_ulg_takes_the_attitude_before_it(tmp_path):
    importorskip("pyulog")
    path = tmp_path / "a.ulg"
    local = [
        "uint64_t timestamp",
        "float x",
        "float y",
        "float z",
        "float vx",
        "float vy",
        "float vz",
        "uint8_t xy_reset_counter",
        "uint8_t z_reset_counter",
        "uint8_t xy_valid",
        "uint8_t z_valid",
    ]
    places = [
        (1_000_000 + 20_000 * i, 0.1 * i, 2.0, -1.0, 5.0, 0.0, 0.0, 1, i // 2, i != 2, i != 3)
        for i in range(4)
    ]
    turns = [(990_000, *YAWED), (1_018_000, 1.0, 0.0, 0.0, 0.0)]
    rates = [(1_015_000, 0.1, 0.2, 0.3)]
    topics = {
        ("vehicle_local_position", 0): (local, places),
        ("vehicle_attitude", 0): (["uint64_t timestamp", "float[4] q"], turns),
        ("vehicle_angular_velocity", 0): (["uint64_t timestamp", "float[3] xyz"], rates),
    }
    files.write_ulg(path, topics)
    poses = read_ulg(path, (LogBody("vehicle", "vehicle_local_position"),))
    assert [pose.quat[0] for pose in poses] == approx([QUARTER, 1.0, 1.0, 1.0])
    assert [pose.rate is None for pose in poses] == [True, False, False, False]
    assert [pose.reset for pose in poses] == [1, 1, 2, 2]
    assert [pose.valid for pose in poses] == [True, True, False, False]
    with raises(SourceError, match=r"no vehicle_odometry in this log.*vehicle_local_position"):
        read_ulg(path, (LogBody("vehicle", "vehicle_odometry"),))
    del topics["vehicle_attitude", 0]
    files.write_ulg(path, topics)
    with raises(SourceError, match="gives no attitude"):
        read_ulg(path, (LogBody("vehicle", "vehicle_local_position"),))


def test_a_log_is_recorded_and_replayed(tmp_path, printed):
    """Vehicle and payload from two loggers through `hil record`, in MAVLink's frames, the policy
    looking on.
    """
    for name, down in (("vehicle", -1.333), ("payload", -0.9)):
        places = [(0.05 * math.sin(0.1 * i), 0.001 * i, down) for i in range(60)]
        rows = [
            ("VISP", (20_000 * i, 0, 20 * i, *place, 0.0, 0.0, 0.0, 0, 0, 0, 0, 100))
            for i, place in enumerate(places)
        ]
        files.write_bin(tmp_path / f"{name}.bin", {"VISP": files.VISP}, rows)
    logs = ", ".join(
        f'{{body="{name}", message="VISP", file="{tmp_path / name}.bin"}}'
        for name in ("vehicle", "payload")
    )
    settings = (
        "source.kind=bin",
        f"source.file={tmp_path}/vehicle.bin",
        f"source.logs=[{logs}]",
    )
    out = tmp_path / "run"
    output = printed(f"hil record --out {out}", sets=settings)
    assert "vehicle: 60 poses taken; refused: none" in output
    assert "payload: 60 poses taken; refused: none" in output
    assert "all bit for bit the same" in printed(f"hil replay {out}")
    tick, *_ = (line for line in lines(out / "ticks.jsonl") if line["observation"] is not None)
    assert tick["observation"][2] == approx(1.333, abs=0.01), "down became up"
