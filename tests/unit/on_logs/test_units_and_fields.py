"""Every unit, and every field of every message that the readers of autopilots name, in a written
log: what comes out against numbers worked by hand.
"""

import math
import struct

import numpy as np
from pymavlink.dialects.v20 import ardupilotmega as dialect
from pytest import approx, mark, raises

from tests import logfiles
from visthrow.common.errors import ConfigError
from visthrow.logs import read
from visthrow.logs.readers import autopilot_logs
from visthrow.logs.readers.blackbox import channels as blackbox
from visthrow.logs.unit_names import UNITS, to_si

IN_OURS = {
    "s": {"s": 1, "ms": 0.001, "us": 0.000001, "ns": 0.000000001, "min": 60},
    "m": {"m": 1, "cm": 0.01, "mm": 0.001, "ft": 0.3048, "in": 0.0254},
    "m/s": {"m/s": 1, "cm/s": 0.01, "mm/s": 0.001},
    "m/s^2": {"m/s^2": 1, "g": 9.80665, "mg": 0.00980665},
    "rad": {"rad": 1, "deg": 0.0174532925199, "mrad": 0.001, "cdeg": 0.000174532925199},
    "rad/s": {"rad/s": 1, "deg/s": 0.0174532925199, "mrad/s": 0.001, "rpm": 0.104719755120},
    "N": {"N": 1, "mN": 0.001, "gf": 0.00980665, "kgf": 9.80665},
    "N m": {"N m": 1, "N mm": 0.001},
    "V": {"V": 1, "mV": 0.001, "cV": 0.01},
    "A": {"A": 1, "mA": 0.001, "cA": 0.01},
    "W": {"W": 1},
    "1": {"1": 1, "%": 0.01, "1/65535": 0.0000152590218967, "1/1000": 0.001},
}
FRAMES = {"1/30 s": 0.0333333333333, "1/50 s": 0.02, "1/60 s": 0.0166666666667, "1/100 s": 0.01}
FRAMES |= {"1/120 s": 0.00833333333333, "1/200 s": 0.005, "1/240 s": 0.00416666666667}
FRAMES |= {"1/250 s": 0.004, "1/300 s": 0.00333333333333, "1/500 s": 0.002, "1/1000 s": 0.001}
IN_OURS["s"] |= FRAMES

FLIPPED = (1.0, -2.0, -3.0)  # of 1, 2, 3 in the autopilots' axes
QUARTER = (0.0, 0.0, -math.sqrt(0.5), math.sqrt(0.5))  # xyzw: a quarter turn to the right
TURNED = (math.sqrt(0.5), 0.0, 0.0, math.sqrt(0.5))  # wxyz, about the autopilots' z
IN_PLACES = (3.0, 1.0, 2.0, 4.0)  # of outputs 1 to 4 of a quadrotor X
RPM = tuple(x * 104.719755120 for x in IN_PLACES)  # of 1000 to 4000 rpm
SPEEDS = (1000, 2000, 3000, 4000)
ULG = [
    ("vehicle_local_position", "x y z", (1, 2, 3), "pos_w", FLIPPED),
    ("vehicle_local_position", "vx vy vz", (1, 2, 3), "vel_w", FLIPPED),
    ("vehicle_attitude", "q*4", TURNED, "quat_wb", QUARTER),
    ("vehicle_angular_velocity", "xyz*3", (1, 2, 3), "rate_b", FLIPPED),
    ("sensor_combined", "gyro_rad*3", (1, 2, 3), "rate_b", FLIPPED),
    ("sensor_combined", "accelerometer_m_s2*3", (1, 2, 3), "acc_b", FLIPPED),
    ("vehicle_local_position_groundtruth", "x y z", (1, 2, 3), "truth_pos_w", FLIPPED),
    ("vehicle_local_position_groundtruth", "vx vy vz", (1, 2, 3), "truth_vel_w", FLIPPED),
    ("vehicle_attitude_groundtruth", "q*4", TURNED, "truth_quat_wb", QUARTER),
    ("vehicle_rates_setpoint", "roll pitch yaw", (1, 2, 3), "rate_setpoint_b", FLIPPED),
    ("vehicle_rates_setpoint", "thrust_body*3", (0, 0, -0.4), "throttle", (0.4,)),
    ("battery_status", "voltage_v", (15.5,), "battery_voltage", (15.5,)),
    ("battery_status", "current_a", (7.5,), "current", (7.5,)),
    ("actuator_motors", "control*4", (1, 2, 3, 4), "motor_command", IN_PLACES),
    ("actuator_outputs", "output*4", (1, 2, 3, 4), "motor_output", IN_PLACES),
    ("esc_status", " ".join(f"esc[{i}].esc_rpm" for i in range(4)), SPEEDS, "motor_speed", RPM),
]
for topic, prefix in (("mocap_", "mocap_"), ("visual_", "mocap_"), ("", "est_")):
    name = f"vehicle_{topic}odometry"
    ULG += [
        (name, "position*3", (1, 2, 3), f"{prefix}pos_w", FLIPPED),
        (name, "x y z", (1, 2, 3), f"{prefix}pos_w", FLIPPED),
        (name, "q*4", TURNED, f"{prefix}quat_wb", QUARTER),
    ]
BIN = [
    ("ATT", "Roll Pitch Yaw", (0, 0, 90), "quat_wb", QUARTER),
    ("IMU", "GyrX GyrY GyrZ", (1, 2, 3), "rate_b", FLIPPED),
    ("IMU", "AccX AccY AccZ", (1, 2, 3), "acc_b", FLIPPED),
    ("VISP", "PX PY PZ", (1, 2, 3), "mocap_pos_w", FLIPPED),
    ("VISP", "R P Y", (0, 0, 90), "mocap_quat_wb", QUARTER),
    ("VISP", "Roll Pitch Yaw", (0, 0, 90), "mocap_quat_wb", QUARTER),
    ("SIM2", "PN PE PD", (1, 2, 3), "truth_pos_w", FLIPPED),
    ("SIM2", "VN VE VD", (1, 2, 3), "truth_vel_w", FLIPPED),
    ("SIM", "Q1 Q2 Q3 Q4", TURNED, "truth_quat_wb", QUARTER),
    ("RATE", "RDes PDes YDes", (90, 180, 270), "rate_setpoint_b", (1.5708, -3.14159, -4.71239)),
    ("BAT", "Volt", (15.5,), "battery_voltage", (15.5,)),
    ("BAT", "Curr", (7.5,), "current", (7.5,)),
    ("RCOU", "C1 C2 C3 C4", (1, 2, 3, 4), "motor_output", IN_PLACES),
    ("RCOU", "Ch1 Ch2 Ch3 Ch4", (1, 2, 3, 4), "motor_output", IN_PLACES),
    ("RCOU", "Chan1 Chan2 Chan3 Chan4", (1, 2, 3, 4), "motor_output", IN_PLACES),
    ("CTUN", "ThO", (0.4,), "throttle", (0.4,)),
]
for core in ("XKF1", "NKF1", "EKF1"):
    BIN.append((core, "PN PE PD", (1, 2, 3), "pos_w", FLIPPED))
    BIN.append((core, "VN VE VD", (1, 2, 3), "vel_w", FLIPPED))
MILLI_G = (0.00980665, -0.0196133, -0.02941995)
TLOG = [
    ("LOCAL_POSITION_NED", "x y z", (1, 2, 3), "pos_w", FLIPPED),
    ("LOCAL_POSITION_NED", "vx vy vz", (1, 2, 3), "vel_w", FLIPPED),
    ("ATTITUDE_QUATERNION", "q1 q2 q3 q4", TURNED, "quat_wb", QUARTER),
    ("ATTITUDE", "roll pitch yaw", (0, 0, 1.5707963), "quat_wb", QUARTER),
    ("ATTITUDE", "rollspeed pitchspeed yawspeed", (1, 2, 3), "rate_b", FLIPPED),
    ("HIGHRES_IMU", "xacc yacc zacc", (1, 2, 3), "acc_b", FLIPPED),
    ("SCALED_IMU", "xacc yacc zacc", (1, 2, 3), "acc_b", MILLI_G),
    ("RAW_IMU", "xacc yacc zacc", (1, 2, 3), "acc_b", MILLI_G),
    ("VISION_POSITION_ESTIMATE", "x y z", (1, 2, 3), "mocap_pos_w", FLIPPED),
    ("ATT_POS_MOCAP", "x y z", (1, 2, 3), "mocap_pos_w", FLIPPED),
    ("ATT_POS_MOCAP", "q*4", TURNED, "mocap_quat_wb", QUARTER),
    (
        "ATTITUDE_TARGET",
        "body_roll_rate body_pitch_rate body_yaw_rate",
        (1, 2, 3),
        "rate_setpoint_b",
        FLIPPED,
    ),
    ("ATTITUDE_TARGET", "thrust", (0.4,), "throttle", (0.4,)),
    ("SYS_STATUS", "voltage_battery", (15500,), "battery_voltage", (15.5,)),
    (
        "SERVO_OUTPUT_RAW",
        "servo1_raw servo2_raw servo3_raw servo4_raw",
        (1, 2, 3, 4),
        "motor_output",
        IN_PLACES,
    ),
    ("ESC_TELEMETRY_1_TO_4", "rpm*4", SPEEDS, "motor_speed", RPM),
]
UPSIDE_DOWN = (math.sqrt(0.5), math.sqrt(0.5), 0.0, 0.0)  # body axes down, world axes up
for frame, place, turn in (
    (1, FLIPPED, QUARTER),
    (14, FLIPPED, QUARTER),
    (20, FLIPPED, QUARTER),
    (21, (1.0, 2.0, 3.0), UPSIDE_DOWN),
):
    TLOG.append(("ODOMETRY", f"x y z frame_id={frame}", (1, 2, 3), "pos_w", place))
    TLOG.append(("ODOMETRY", f"q*4 frame_id={frame}", TURNED, "quat_wb", turn))


def write_ulg(path, message, fields, values):
    words = [field.partition("*")[::2] for field in fields.split()]
    declared = [f"float[{count}] {name}" if count else f"float {name}" for name, count in words]
    rows = [(1_000_000 + 50_000 * i, *values) for i in range(5)]
    logfiles.write_ulg(path, {(message, 0): (["uint64_t timestamp", *declared], rows)})


def write_bin(path, message, fields, values):
    names = fields.split()
    form = ("Q" + "f" * len(names), ",".join(["TimeUS", *names]))
    rows = [(message, (1_000_000 + 50_000 * i, *values)) for i in range(5)]
    logfiles.write_bin(path, {message: form}, rows)


def write_tlog(path, message, fields, values):
    kind = getattr(dialect, f"MAVLink_{message.lower()}_message")
    lengths = dict(zip(kind.ordered_fieldnames, kind.array_lengths))
    content = {name: [0] * lengths[name] if lengths[name] else 0 for name in kind.fieldnames}
    rest = list(values)
    for word in fields.split():
        name, _, number = word.partition("=")
        name, _, count = name.partition("*")
        content[name] = int(number) if number else rest[: int(count)] if count else rest.pop(0)
    sender, out = dialect.MAVLink(None), b""
    for i in range(5):
        out += struct.pack(">Q", 1_700_000_000_000_000 + 20_000 * i)
        stamps = {"time_boot_ms": 20 * i, "time_usec": 20_000 * (i + 1)}
        out += kind(**content | {k: v for k, v in stamps.items() if k in content}).pack(sender)
    path.write_bytes(out)


WRITERS = {"ulg": write_ulg, "BIN": write_bin, "tlog": write_tlog}
ROWS = {"ulg": ULG, "BIN": BIN, "tlog": TLOG}
CASES = [(ending, *row) for ending, rows in ROWS.items() for row in rows]


def test_units():
    worked = {unit: (ours, size) for ours, units in IN_OURS.items() for unit, size in units.items()}
    assert worked.keys() == UNITS.keys()
    for unit, (ours, size) in worked.items():
        assert to_si(unit, "here") == (ours, approx(size, rel=1e-10)), unit
    with raises(ConfigError, match="here: unit 'parsec'"):
        to_si("parsec", "here")


@mark.parametrize(
    ("ending", "message", "fields", "values", "channel", "expected"),
    CASES,
    ids=[f"{ending}-{row[0]}-{row[1]}" for ending, *row in CASES],
)
def test_a_field_of_an_autopilot(ending, message, fields, values, channel, expected, tmp_path):
    path = tmp_path / f"a.{ending}"
    WRITERS[ending](path, message, fields, values)
    (log,) = read(path)
    assert log.meta["ingest"][channel]["message"] == message
    got = log[channel].values.reshape(5, -1)
    if channel.endswith("quat_wb"):
        got = got * np.sign(got @ expected)[:, None]  # both signs are one attitude
    np.testing.assert_allclose(got, np.tile(expected, (5, 1)), rtol=1e-5, atol=1e-6)


@mark.parametrize(
    ("ending", "kind"), [("ulg", "ulog"), ("BIN", "dataflash"), ("tlog", "telemetry")]
)
def test_no_field_is_untested(ending, kind):
    taps = autopilot_logs.fields_of_autopilots()["taps"][kind]
    written = {(row[0], row[3]) for row in ROWS[ending]}
    named = {(tap.message, tap.channel) for tap in taps} - {("ESC", "motor_speed")}
    assert written == named


@mark.parametrize(
    ("title", "value", "channel", "expected"),
    [
        ("gyroADC[0] (deg/s)", 180.0, "rate_b", math.pi),
        ("gyroADC[0] (rad/s)", 2.0, "rate_b", 2.0),
        ("accSmooth[0] (g)", 0.5, "acc_b", 4.903325),
        ("accSmooth[0] (m/s/s)", 3.0, "acc_b", 3.0),
        ("vbatLatest (V)", 15.5, "battery_voltage", 15.5),
        ("amperageLatest (A)", 7.5, "current", 7.5),
        ("setpoint[0] (deg/s)", 90.0, "rate_setpoint_b", math.pi / 2),
        ("setpoint[3]", 250.0, "throttle", 0.25),
        ("motor[3]", 1102.5, "motor_command", 0.5),
        ("eRPM[3]", 70.0, "motor_speed", 1000.0 * math.pi / 30),
    ],
)
def test_a_field_of_a_decoded_blackbox(title, value, channel, expected):
    """Motor 3 is ours 0; a motor of 14 poles turns 100 / 7 times for one of eRPM."""
    rest = {f"{name}[{i}]" for name in ("gyroADC", "accSmooth", "setpoint") for i in range(3)}
    rest |= {f"{name}[{i}]" for name in ("motor", "eRPM") for i in range(4)}
    table = dict.fromkeys(rest, np.zeros(3)) | {"loopIteration": np.arange(3)}
    table.pop(title.split(" ")[0], None)
    table |= {"time (us)": np.array([0.0, 500.0, 1000.0]), title: np.full(3, value)}
    log = blackbox.log_of_decoded(table, "a.csv")
    assert log[channel].values.reshape(3, -1)[:, 0] == approx(expected)
    assert log[channel].time[-1] == approx(1e-3)


@mark.parametrize(("unit", "size"), [("us", 1e-6), ("ms", 1e-3), ("s", 1.0)])
def test_stamps_of_a_decoded_blackbox(unit, size):
    table = {f"time ({unit})": np.array([5.0, 6.0, 8.0]), "vbatLatest": np.ones(3)}
    log = blackbox.log_of_decoded(table, "a.csv")
    assert log["battery_voltage"].time == approx([0.0, size, 3.0 * size])


def test_the_clock_of_a_blackbox_turns_over():
    table = {"time": np.array([2.0**32 - 1000.0, 1000.0, 3000.0]), "vbatLatest": np.ones(3)}
    log = blackbox.log_of_decoded(table, "a.csv")
    assert log["battery_voltage"].time == approx([0.0, 0.002, 0.004])
