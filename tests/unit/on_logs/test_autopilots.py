"""An autopilot log's metadata: validity, vehicle, motors, speeds, clocks, damage."""

import math
import struct
import tomllib

import numpy as np
from pymavlink.dialects.v20 import ardupilotmega as dialect
from pytest import approx, fixture, importorskip, mark, raises

from tests import logfiles
from tests.places import DATA
from visthrow.common.errors import LogError
from visthrow.logs import read
from visthrow.logs.check.run import check, contradictions

LOCAL = ["uint64_t timestamp", *(f"float {x}" for x in ["x", "y", "z", "vx", "vy", "vz", "eph"])]
LOCAL += [f"uint8_t {name}" for name in ["xy_valid", "z_valid", "v_xy_valid", "v_z_valid"]]
LOCAL += ["uint8_t xy_reset_counter"]
ROTOR_PLACES = {0: (1, 1), 1: (-1, -1), 2: (1, -1), 3: (-1, 1)}  # forward, right: PX4's X
VEHICLES = tomllib.loads((DATA / "vehicles.toml").read_text(encoding="utf-8"))


def swing(i):
    return math.sin(0.1 * i)


def ulog(path, *, flags=(1, 1, 1, 1), eph=0.3, resets=0, topics=None, parameters=None):
    """A flight of 15 s along x, with flags of the estimate from the middle on."""
    local, attitude = [], []
    for i in range(300):
        t, late = 1_000_000 + 50_000 * i, i >= 150
        good = flags if late else (1, 1, 1, 1)
        place = (swing(i), 0.0, -1.5, 2.0 * math.cos(0.1 * i), 0.0, 0.0)
        local.append((t, *place, eph if late else 0.3, *good, resets if late else 0))
        attitude.append((t, 1.0, 0.01 * swing(i), 0.0, 0.0))
    standard = {
        ("vehicle_local_position", 0): (LOCAL, local),
        ("vehicle_attitude", 0): (["uint64_t timestamp", "float[4] q"], attitude),
    }
    logfiles.write_ulg(path, standard | (topics or {}), parameters)
    return path


def outputs(name, field, size, moving, first=0.5):
    """A topic of so many outputs of which some move."""
    rows = []
    for i in range(300):
        values = [first + 0.1 * swing(i + k) if k in moving else 0.0 for k in range(size)]
        rows.append((1_000_000 + 50_000 * i, *values))
    return ["uint64_t timestamp", f"float[{size}] {field}"], rows


@fixture
def px4(tmp_path):
    """Function that returns the log of what `ulog` writes."""
    return lambda **options: read(ulog(tmp_path / "a.ulg", **options))[0]


@fixture
def ardupilot(tmp_path):
    """Function that returns the log of a dataflash file with some messages."""

    def log(formats, rows):
        logfiles.write_bin(tmp_path / "a.BIN", formats, rows)
        return read(tmp_path / "a.BIN")[0]

    return log


@mark.parametrize(("change", "channel", "word"), VEHICLES["invalid"])
def test_what_the_estimator_calls_invalid_is_invalid(change, channel, word, px4):
    log = px4(**change)
    valid = log[channel].valid
    assert np.all(valid[:150])
    assert not np.any(valid[150:])
    rows = [row.text for row in check([log])[0].rows if row.channel == channel]
    assert any("50 % of the samples are not valid by the autopilot's own word" in t for t in rows)
    assert any(word in text for text in rows)


def test_the_tables_that_ulog2csv_writes_are_read_as_the_log(px4, tmp_path):
    """By the folder, and by any of them."""
    convert = importorskip("pyulog.ulog2csv").convert_ulog2csv
    log = px4()
    (tmp_path / "b").mkdir()
    convert(str(tmp_path / "a.ulg"), None, str(tmp_path / "b"), ",", None, None)
    for path in (tmp_path / "b", tmp_path / "b" / "a_vehicle_local_position_0.csv"):
        (again,) = read(path)
        assert again.channels.keys() == log.channels.keys()
        for name, channel in log.channels.items():
            assert again[name].time == approx(channel.time)
            assert again[name].values == approx(channel.values, rel=1e-5)
    path.write_text("a,b\n1,2\n")
    with raises(LogError, match="no column 'timestamp'"):
        read(tmp_path / "b")


def test_a_reset_of_the_estimate_is_reported(px4):
    rows = check([px4(resets=1)])[0].rows
    assert any("reset 1 times" in row.text for row in rows if row.channel == "pos_w")


@mark.parametrize(("parameters", "kind"), VEHICLES["px4"])
def test_motors_of_another_vehicle_are_left_out_by_its_name(parameters, kind, px4):
    motors = {("actuator_motors", 0): outputs("", "control", 12, range(6))}
    log = px4(topics=motors, parameters=parameters)
    assert "motor_command" not in log
    if not kind:
        left = ["actuator_motors: 6 motors move, not the four of a quadrotor"]
        assert log.meta["left_out"] == left
        return
    assert log.meta["vehicle"] == kind
    checked = check([log])[0]
    assert any(f"of a {kind}" in row.text for row in checked.rows)
    assert not [row for row in checked.rows if "motor" in row.channel]
    if kind in ("plane", "VTOL", "rover"):
        assert not [row for row in checked.rows if row.topic in ("answers", "thrust", "delay")]
        assert any(kind in text for text in contradictions([checked]))


@mark.parametrize("shift", [0, 1, 3])
def test_motors_are_ordered_by_where_they_sit(shift, px4):
    parameters: dict[str, float] = {"CA_ROTOR_COUNT": 4, "MAV_TYPE": 2}
    for i in range(4):
        ahead, right = ROTOR_PLACES[(i + shift) % 4]
        parameters |= {f"CA_ROTOR{i}_PX": 0.2 * ahead, f"CA_ROTOR{i}_PY": 0.3 * right}
    rows = [(1_000_000 + 50_000 * i, *(k + 0.1 * swing(i) for k in range(4))) for i in range(300)]
    topic = {("actuator_motors", 0): (["uint64_t timestamp", "float[4] control"], rows)}
    log = px4(topics=topic, parameters=parameters)
    expected = [(motor - shift) % 4 for motor in (2, 0, 1, 3)]  # FL FR RL RR
    assert np.round(log["motor_command"].values[0]).tolist() == expected


def test_the_instance_that_moves_is_taken(px4):
    topics = {
        ("actuator_outputs", 0): outputs("", "output", 16, (), first=0.0),
        ("actuator_outputs", 1): outputs("", "output", 16, range(4), first=1500.0),
    }
    log = px4(topics=topics)
    assert log["motor_output"].values.min() > 1400.0
    assert log.meta["ingest"]["motor_output"]["instance"] == 1


@mark.parametrize(
    ("arming", "landed", "flown"), [(2, 0, True), (1, 0, False), (2, 1, False), (1, 1, False)]
)
def test_a_vehicle_on_the_desk_has_not_flown(arming, landed, flown, px4):
    times = [1_000_000 + 500_000 * i for i in range(30)]
    topics = {
        ("vehicle_status", 0): (
            ["uint64_t timestamp", "uint8_t arming_state"],
            [(t, arming) for t in times],
        ),
        ("vehicle_land_detected", 0): (
            ["uint64_t timestamp", "uint8_t landed"],
            [(t, landed) for t in times],
        ),
    }
    log = px4(topics=topics)
    assert bool(np.all(log["flying"].values)) == flown
    words = " ".join(row.text for row in check([log])[0].rows)
    assert ("never armed and in the air" in words) != flown
    assert ("0 s flown" in words) != flown


def test_rotor_speeds_of_escs_that_log_one_by_one(ardupilot):
    formats = {"ATT": logfiles.ATT, "ESC": ("QBff", "TimeUS,Instance,RPM,Volt")}
    messages = []
    for i in range(100):
        t = 1_000_000 + 20_000 * i
        messages.append(("ATT", (t, 0, 1.0, 0, 0.0, 0, 0.0)))
        messages += [("ESC", (t + k, k, 6000.0 + 100 * k, 15.0)) for k in range(4)]
    speeds = ardupilot(formats, messages)["motor_speed"].values[0] * 30 / np.pi
    assert speeds == approx([6200, 6000, 6100, 6300])


def write_tlog(path, more, local=True):
    """A .tlog of a vehicle that booted 100 s before; ``more`` makes messages of encoder and row."""
    mav, out = dialect.MAVLink(None, 1, 1), []
    for i in range(200):
        s = 0.02 * i
        messages = [
            mav.heartbeat_encode(2, 3, 128, 0, 4),
            mav.attitude_encode(int(1e3 * (100.0 + s)), 0.1 * swing(i), 0, 0, 0, 0, 0),
            *more(mav, i),
        ]
        if local:
            place = (swing(i), 0.0, -1.5, 5.0 * math.cos(0.1 * i), 0.0, 0.0)
            messages.append(mav.local_position_ned_encode(int(1e3 * (100.0 + s)), *place))
        stamp = struct.pack(">Q", int((1.7e9 + s) * 1e6))
        out += [stamp + bytes(message.pack(mav)) for message in messages]
    path.write_bytes(b"".join(out))
    return path


def test_messages_without_a_stamp_or_with_another_clock_share_the_clock_of_the_file(tmp_path):
    def more(mav, i):
        boot, epoch = int((100.0 + 0.02 * i) * 1e6), int((1.7e9 + 0.02 * i - 0.005) * 1e6)
        return [
            mav.sys_status_encode(0, 0, 0, 0, 15000 + i, 0, 0, 0, 0, 0, 0, 0, 0),
            mav.vision_position_estimate_encode(boot, swing(i), 0.0, -1.5, 0.0, 0.0, 0.0),
            mav.att_pos_mocap_encode(epoch, [1, 0, 0, 0], swing(i), 0.0, -1.5),
            mav.highres_imu_encode(boot, 0, 0, -9.8, 0, 0, 0, 0, 0, 0, 0, 0, 0, 0, 0),
        ]

    log = read(write_tlog(tmp_path / "a.tlog", more))[0]
    for name in ("battery_voltage", "mocap_pos_w", "mocap_quat_wb", "acc_b"):
        assert log[name].time[0] == approx(0.0, abs=0.02), name
    assert "never overlap" not in str(check([log])[0].rows)


def test_a_ground_stations_heartbeat_is_not_the_vehicles(tmp_path):
    """The station's messages come first, and it is not armed."""
    path, station = (
        write_tlog(tmp_path / "a.tlog", lambda mav, i: []),
        dialect.MAVLink(None, 255, 0),
    )
    first = struct.pack(">Q", int(1.7e9 * 1e6)) + bytes(
        station.heartbeat_encode(6, 8, 0, 0, 4).pack(station)
    )
    path.write_bytes(first + path.read_bytes())
    log = read(path)[0]
    assert log["flying"].values.all()
    assert not any("HEARTBEAT" in part for part in log.meta["left_out"])


def test_another_senders_messages_are_left_out_by_name(tmp_path):
    def more(mav, i):
        return [mav.sys_status_encode(0, 0, 0, 0, 15000, 0, 0, 0, 0, 0, 0, 0, 0)]

    path, other = write_tlog(tmp_path / "a.tlog", more), dialect.MAVLink(None, 2, 190)
    late = struct.pack(">Q", int((1.7e9 + 1.0) * 1e6))
    report = other.sys_status_encode(0, 0, 0, 0, 9000, 0, 0, 0, 0, 0, 0, 0, 0)
    path.write_bytes(path.read_bytes() + late + bytes(report.pack(other)))
    log = read(path)[0]
    assert set(log["battery_voltage"].values) == {15.0}
    assert "1 SYS_STATUS of system 2, component 190: of another sender" in log.meta["left_out"]


@mark.parametrize(("frame", "known"), [(1, True), (21, True), (8, False)])
def test_odometry_of_a_failed_tracker_or_of_another_frame_is_no_position(frame, known, tmp_path):
    nan = [math.nan] * 21

    def more(mav, i):
        boot, quality = int((100.0 + 0.02 * i) * 1e6), -1 if i >= 100 else 50
        place = (swing(i), 0.3 * swing(i), -1.5, [1, 0, 0, 0], 0, 0, 0, 0, 0, 0)
        return [mav.odometry_encode(boot, frame, 12, *place, nan, nan, 0, 0, quality)]

    log = read(write_tlog(tmp_path / "a.tlog", more, local=False))[0]
    assert ("pos_w" in log) == known
    if known:
        assert log["pos_w"].valid.tolist() == [True] * 100 + [False] * 100
    else:
        assert any("ODOMETRY: its frame_id is 8" in part for part in log.meta["left_out"])


def test_one_stamp_that_is_ahead_of_all_others_costs_its_row_alone(ardupilot):
    rows = [("ATT", (1_000_000 + 20_000 * i, 0, swing(i), 0, 0.0, 0, 0.0)) for i in range(200)]
    rows[100] = ("ATT", (4_000_000_000_000_000_000, 0, 1.0, 0, 0.0, 0, 0.0))
    log = ardupilot({"ATT": logfiles.ATT}, rows)
    assert len(log["quat_wb"].time) == 199
    assert log["quat_wb"].time[-1] == approx(3.98)


def test_ardupilots_older_logs_count_in_milliseconds(ardupilot):
    formats = {
        "ATT": ("Icccccc", "TimeMS,DesRoll,Roll,DesPitch,Pitch,DesYaw,Yaw"),
        "EKF1": ("IccCfffffff", "TimeMS,Roll,Pitch,Yaw,VN,VE,VD,PN,PE,PD,GX"),
    }
    rows = []
    for i in range(200):
        rows.append(("ATT", (1000 + 20 * i, 0.0, 10.0, 0.0, 0.0, 0.0, 0.0)))
        rows.append(("EKF1", (1000 + 20 * i, 0.0, 0.0, 0.0, 1.0, 0, 0, swing(i), 0.0, -2.0, 0)))
    log = ardupilot(formats, rows)
    assert log["pos_w"].time[-1] == approx(3.98)
    assert log["pos_w"].values[0, 2] == approx(2.0)
    assert log["quat_wb"].values[0, 0] == approx(math.sin(math.radians(5.0)), abs=1e-3)


@mark.parametrize(("parameters", "firmware", "kind"), VEHICLES["ardupilot"])
def test_ardupilots_frame_says_which_output_is_which_rotor(parameters, firmware, kind, ardupilot):
    names = ",".join(f"C{i}" for i in range(1, 15))
    formats = {
        "PARM": ("QNf", "TimeUS,Name,Value"),
        "MSG": ("QZ", "TimeUS,Message"),
        "ATT": logfiles.ATT,
        "RCOU": ("Q" + "H" * 14, f"TimeUS,{names}"),
    }
    rows = [("MSG", (1000, firmware.encode()))]
    rows += [("PARM", (1000, name.encode(), float(x))) for name, x in parameters.items()]
    for i in range(100):
        t = 1_000_000 + 20_000 * i
        rows.append(("ATT", (t, 0, 1.0, 0, 0.0, 0, 0.0)))
        rows.append(("RCOU", (t, *(1000 + 10 * n + i % 3 for n in range(1, 15)))))
    log = ardupilot(formats, rows)
    assert log.meta["vehicle"] == kind
    refused = any(row.topic == "vehicle" for row in check([log])[0].rows)
    assert refused == (kind in ("plane", "VTOL"))  # rotors in a plus fly by the same physics
    if kind != "quadrotor":
        assert "motor_output" not in log
        return
    order = [4, 2, 3, 1] if parameters["FRAME_TYPE"] == 12.0 else [3, 9, 2, 4]
    assert log["motor_output"].values[0].tolist() == [1000 + 10 * n for n in order]


@mark.parametrize(("ignored", "quality", "good"), [(0, 0, True), (1, 0, False), (0, -1, False)])
def test_external_poses_that_ardupilot_ignored_are_invalid(ignored, quality, good, ardupilot):
    rows = [
        ("VISP", (1000 * i, 0, i, swing(i), 0.0, -1.0, 0, 0, 0, 0, 0, 0, ignored, quality))
        for i in range(10)
    ]
    assert np.all(ardupilot({"VISP": logfiles.VISP}, rows)["mocap_pos_w"].valid == good)
