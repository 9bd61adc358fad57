"""Logs of autopilots as flight logs: PX4's ULog, ArduPilot's DataFlash (.BIN) and MAVLink telemetry (.tlog).

All of them are north-east-down and forward-right-down; ours become x north, y west, z up and forward, left, up.
"""

import io
import math
import os
import tempfile
from collections.abc import Iterable, Iterator
from contextlib import contextmanager, redirect_stderr, redirect_stdout
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from visthrow.common.errors import LogError
from visthrow.logs.damaged import Forward
from visthrow.logs.flightlog import FlightLog
from visthrow.logs.mapping import ChannelMap
from visthrow.logs.table import make_channel

NED = "x,-y,-z"
"""Our axes in the autopilot's, world and body alike."""


@dataclass(frozen=True)
class Tap:
    """Fields of one kind of message that make a channel; of taps to one channel the first that is there is used."""

    message: str
    fields: tuple[str, ...]
    channel: str
    unit: str
    kind: str = "vector"
    flip: bool = True  # from forward-right-down or north-east-down
    frame: str = ""
    scale: float = 1.0


def _t(message: str, fields: str, channel: str, unit: str, **more) -> Tap:
    return Tap(message, tuple(fields.split()), channel, unit, **more)


ULOG = (
    _t("vehicle_local_position", "x y z", "pos_w", "m"),
    _t("vehicle_local_position", "vx vy vz", "vel_w", "m/s"),
    _t("vehicle_attitude", "q[0] q[1] q[2] q[3]", "quat_wb", "1", kind="quaternion"),
    _t("vehicle_angular_velocity", "xyz[0] xyz[1] xyz[2]", "rate_b", "rad/s"),
    _t("sensor_combined", "gyro_rad[0] gyro_rad[1] gyro_rad[2]", "rate_b", "rad/s"),
    _t("sensor_combined", "accelerometer_m_s2[0] accelerometer_m_s2[1] accelerometer_m_s2[2]", "acc_b", "m/s^2", frame="body"),
    _t("vehicle_visual_odometry", "position[0] position[1] position[2]", "mocap_pos_w", "m", frame="world"),
    _t("vehicle_visual_odometry", "q[0] q[1] q[2] q[3]", "mocap_quat_wb", "1", kind="quaternion", frame="world"),
    _t("vehicle_rates_setpoint", "roll pitch yaw", "rate_setpoint_b", "rad/s", frame="body"),
    _t("battery_status", "voltage_v", "battery_voltage", "V", flip=False),
    _t("battery_status", "current_a", "current", "A", flip=False),
    _t("actuator_motors", "control[2] control[0] control[1] control[3]", "motor_command", "1", flip=False),
    _t("actuator_outputs", "output[2] output[0] output[1] output[3]", "motor_output", "1", flip=False),
)
"""PX4's quad X: motors front right, rear left, front left, rear right."""

DATAFLASH = (
    _t("XKF1", "PN PE PD", "pos_w", "m"),
    _t("NKF1", "PN PE PD", "pos_w", "m"),
    _t("XKF1", "VN VE VD", "vel_w", "m/s"),
    _t("NKF1", "VN VE VD", "vel_w", "m/s"),
    _t("ATT", "Roll Pitch Yaw", "quat_wb", "deg", kind="euler"),
    _t("IMU", "GyrX GyrY GyrZ", "rate_b", "rad/s"),
    _t("IMU", "AccX AccY AccZ", "acc_b", "m/s^2", frame="body"),
    _t("VISP", "PX PY PZ", "mocap_pos_w", "m", frame="world"),
    _t("RATE", "RDes PDes YDes", "rate_setpoint_b", "deg/s", frame="body"),
    _t("BAT", "Volt", "battery_voltage", "V", flip=False),
    _t("BAT", "Curr", "current", "A", flip=False),
    _t("RCOU", "C3 C1 C2 C4", "motor_output", "1", flip=False),
    _t("CTUN", "ThO", "throttle", "1", flip=False),
)
"""ArduPilot's quad X: motors front right, rear left, front left, rear right."""

TELEMETRY = (
    _t("LOCAL_POSITION_NED", "x y z", "pos_w", "m"),
    _t("LOCAL_POSITION_NED", "vx vy vz", "vel_w", "m/s"),
    _t("ATTITUDE_QUATERNION", "q1 q2 q3 q4", "quat_wb", "1", kind="quaternion"),
    _t("ATTITUDE", "roll pitch yaw", "quat_wb", "rad", kind="euler"),
    _t("ATTITUDE", "rollspeed pitchspeed yawspeed", "rate_b", "rad/s"),
    _t("HIGHRES_IMU", "xacc yacc zacc", "acc_b", "m/s^2", frame="body"),
    _t("SCALED_IMU", "xacc yacc zacc", "acc_b", "mg", frame="body"),
    _t("RAW_IMU", "xacc yacc zacc", "acc_b", "mg", frame="body"),
    _t("VISION_POSITION_ESTIMATE", "x y z", "mocap_pos_w", "m", frame="world"),
    _t("ATT_POS_MOCAP", "x y z", "mocap_pos_w", "m", frame="world"),
    _t("SYS_STATUS", "voltage_battery", "battery_voltage", "mV", flip=False),
    _t("SERVO_OUTPUT_RAW", "servo3_raw servo1_raw servo2_raw servo4_raw", "motor_output", "1", flip=False),
)

_STDERR = 2

Messages = dict[str, dict[str, np.ndarray]]
"""Message -> field -> values; ``time`` [s] among the fields."""


def log_of_ulog(path: str | Path) -> FlightLog:
    """Read PX4's ``.ulg``.

    Raises:
        LogError: pyulog is not installed, the file is none, is cut short within its header, or holds nothing we know.
    """
    try:
        from pyulog import ULog
    except ModuleNotFoundError as error:
        raise LogError(f"{path}: reading ULog needs pyulog; install it with: pip install 'visthrow[logs]'") from error
    _expect_file(path)
    try:
        with _quietly():
            read = ULog(Forward(Path(path).read_bytes()), list({tap.message for tap in ULOG}))
    except Exception as error:  # pyulog has no errors of its own: struct, TypeError, IndexError, UnicodeDecodeError
        raise LogError(f"{path}: cannot be read: {error!r}; expected a ULog file") from error
    messages: Messages = {}
    for data in read.data_list:
        if data.multi_id == 0 and "timestamp" in data.data:
            messages[data.name] = {**data.data, "time": data.data["timestamp"] * 1e-6}
    drops = [(drop.timestamp * 1e-6, drop.duration * 1e-3) for drop in read.dropouts]
    return _to_log(messages, ULOG, path, {"kind": "ulog", "dropouts": drops, "damaged": bool(read.file_corruption)})


def log_of_dataflash(path: str | Path) -> FlightLog:
    """Read ArduPilot's ``.BIN``.

    Raises:
        LogError: It is none, or holds nothing we know.
    """
    from pymavlink import DFReader

    _expect_file(path)
    return _read_messages(path, lambda: DFReader.DFReader_binary(str(path)), DATAFLASH, "dataflash", _dataflash_time)


def log_of_telemetry(path: str | Path) -> FlightLog:
    """Read MAVLink telemetry, ``.tlog``.

    Raises:
        LogError: It is none, or holds nothing we know.
    """
    from pymavlink import mavutil

    _expect_file(path)
    return _read_messages(
        path, lambda: mavutil.mavlogfile(str(path), robust_parsing=True), TELEMETRY, "telemetry", _telemetry_time
    )


def _dataflash_time(message) -> float:
    return float(message.TimeUS) * 1e-6


def _telemetry_time(message) -> float:
    """The sender's own stamp where there is one, else the arrival's."""
    if hasattr(message, "time_boot_ms"):
        return message.time_boot_ms * 1e-3
    return message.time_usec * 1e-6 if hasattr(message, "time_usec") else message._timestamp


def _read_messages(path, opened, taps: Iterable[Tap], kind: str, time_of) -> FlightLog:
    wanted: dict[str, set[str]] = {}
    for tap in taps:
        wanted.setdefault(tap.message, set()).update(tap.fields)
    rows: dict[str, dict[str, list[float]]] = {}
    first_of: dict[str, int] = {}
    complaints = []
    try:
        with _quietly() as complaints:
            source = opened()
            while (message := source.recv_match(type=list(wanted))) is not None:
                name = message.get_type()
                instance = getattr(message, "I", getattr(message, "C", 0))
                if first_of.setdefault(name, instance) != instance or not all(hasattr(message, f) for f in wanted[name]):
                    continue
                row = rows.setdefault(name, {field: [] for field in ("time", *wanted[name])})
                row["time"].append(time_of(message))
                for field in wanted[name]:
                    row[field].append(float(getattr(message, field)))
    except Exception as error:  # pymavlink raises whatever struct, mmap and itself raise
        if not rows:
            raise LogError(f"{path}: cannot be read: {error!r}; expected a {kind} log") from error
    messages = {name: {f: np.array(v) for f, v in fields.items()} for name, fields in rows.items()}
    return _to_log(messages, taps, path, {"kind": kind, "damaged": bool(complaints)})


@contextmanager
def _quietly() -> Iterator[list[str]]:
    """What readers of others print of damaged bytes, some of them a line a byte and past Python, in a list instead."""
    said: list[str] = []
    heard = io.StringIO()
    with tempfile.TemporaryFile() as file:
        kept = os.dup(_STDERR)
        os.dup2(file.fileno(), _STDERR)
        try:
            with redirect_stdout(heard), redirect_stderr(heard):
                yield said
        finally:
            os.dup2(kept, _STDERR)
            os.close(kept)
            file.seek(0)
            said += [*heard.getvalue().splitlines(), *file.read().decode(errors="replace").splitlines()]


def _expect_file(path: str | Path) -> None:
    try:
        size = Path(path).stat().st_size
    except OSError as error:
        raise LogError(f"{path}: cannot be read: {error.strerror}") from error
    if size == 0:
        raise LogError(f"{path}: empty; expected a log")


def _to_log(messages: Messages, taps: Iterable[Tap], path: str | Path, meta: dict) -> FlightLog:
    channels, notes = {}, {}
    for tap in taps:
        fields = messages.get(tap.message)
        if fields is None or tap.channel in channels or not all(field in fields for field in tap.fields):
            continue
        flip = NED if tap.flip and (len(tap.fields) == 3 or tap.kind != "vector") else ""
        entry = ChannelMap(
            tap.channel, tap.fields, tap.unit, kind=tap.kind, order="wxyz" if tap.kind == "quaternion" else "xyzw",
            axes=flip, body_axes=flip if tap.kind != "vector" else "", frame=tap.frame, scale=tap.scale,
        )  # fmt: skip
        with np.errstate(invalid="ignore"):  # damaged floats
            values = np.column_stack([fields[field] for field in tap.fields]).astype(float)
        channels[tap.channel], found = make_channel(np.asarray(fields["time"], float), values, entry, str(path))
        notes[tap.channel] = found | {"clock": "autopilot", "message": tap.message}
    if not any(len(channel.time) for channel in channels.values()):
        known = ", ".join(sorted({tap.message for tap in taps}))
        raise LogError(f"{path}: no message of a vehicle's motion in it; known: {known}")
    start = min(float(channel.time[0]) for channel in channels.values() if len(channel.time))
    for name, channel in channels.items():
        channels[name] = type(channel)(channel.time - start, channel.values, channel.unit, channel.frame, channel.valid)
    if not math.isfinite(start):
        raise LogError(f"{path}: stamps are not finite")
    return FlightLog(channels, {"source": str(path), "start": start, "ingest": notes, **meta})
