"""Logs of autopilots as flight logs:

PX4's ULog, ArduPilot's DataFlash (.BIN) and MAVLink telemetry (.tlog).

All of them are north-east-down and forward-right-down; ours become x north, y west, z up and
forward, left, up."""

import math
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np

from visthrow.common.errors import LogError
from visthrow.common.rotations import rotate
from visthrow.logs.flightlog import Channel, FlightLog
from visthrow.logs.mapping import ChannelMap
from visthrow.logs.readers.messages import (
    Fields,
    Messages,
    read_dataflash,
    read_telemetry,
    read_ulog,
)
from visthrow.logs.readers.table import make_channel
from visthrow.logs.readers.vehicles import Vehicle, vehicle_of

NED = "x,-y,-z"  # our axes in the autopilot's, world and body alike
WIDEST_EPH = 5.0  # PX4's COM_POS_FS_EPH: a position worse than this is none [m]
Range = tuple[str, float, float]
"""A field, and the least and largest value with which a sample is valid."""


@dataclass(frozen=True)
class Tap:
    """Fields of one kind of message that make a channel."""

    message: str
    # its columns may hold {0} to {3}, motors front left, front right, rear left, rear right, from 0
    entry: ChannelMap
    good: tuple[Range, ...] = ()  # a sample is valid where all of these fields that it has are so
    only: tuple[Range, ...] = ()  # rows of other values are of another kind


def _t(
    message: str,
    fields: str,
    channel: str,
    unit: str,
    kind: str = "vector",
    good: str = "",
    only: tuple[Range, ...] = (),
    axes: str = NED,
    **options,
) -> Tap:
    """Return a tap; of those to one channel the first that is there is used. ``good``: flags that
    are 1 where a sample is valid, or quality, which is 0 or more.
    """
    columns = tuple(fields.split())
    turned = kind != "vector"
    order = "wxyz" if kind == "quaternion" else "xyzw"
    conditions = tuple(RANGES.get(flag, (flag, 1.0, math.inf)) for flag in good.split())
    entry = ChannelMap(
        channel,
        columns,
        unit,
        kind,  # type: ignore[arg-type]
        order,
        axes=axes if turned or len(columns) == 3 else "",
        body_axes=NED if turned else "",
        **options,
    )
    return Tap(message, entry, conditions, only)


RANGES = {
    "quality": ("quality", 0.0, math.inf),  # -1: the tracker has failed
    "Q": ("Q", 0.0, math.inf),
    "Ign": ("Ign", 0.0, 0.0),
    "eph": ("eph", 0.0, WIDEST_EPH),
}
"""Flags that are no plain flags."""
FOUR = "{0} {1} {2} {3}"


def _motors(pattern: str) -> str:
    """Columns of four motors, of a pattern with an asterisk where the motor's number stands."""
    return " ".join(pattern.replace("*", place) for place in FOUR.split())


def _vector(name: str, count: int = 3) -> str:
    return " ".join(f"{name}[{i}]" for i in range(count))


def _odometry(message: str, prefix: str) -> tuple[Tap, ...]:
    """Position and attitude of PX4's VehicleOdometry, of today and before 1.14."""
    world = {"frame": "world", "good": "quality"}
    return (
        _t(message, _vector("position"), f"{prefix}pos_w", "m", **world),
        _t(message, "x y z", f"{prefix}pos_w", "m", **world),
        _t(message, _vector("q", 4), f"{prefix}quat_wb", "1", "quaternion", **world),
    )


ULOG = (
    _t("vehicle_local_position", "x y z", "pos_w", "m", good="xy_valid z_valid eph"),
    _t("vehicle_local_position", "vx vy vz", "vel_w", "m/s", good="v_xy_valid v_z_valid"),
    _t("vehicle_attitude", _vector("q", 4), "quat_wb", "1", "quaternion"),
    _t("vehicle_angular_velocity", _vector("xyz"), "rate_b", "rad/s"),
    _t("sensor_combined", _vector("gyro_rad"), "rate_b", "rad/s"),
    _t("sensor_combined", _vector("accelerometer_m_s2"), "acc_b", "m/s^2", frame="body"),
    *_odometry("vehicle_mocap_odometry", "mocap_"),
    *_odometry("vehicle_visual_odometry", "mocap_"),
    *_odometry("vehicle_odometry", "est_"),
    _t("vehicle_local_position_groundtruth", "x y z", "truth_pos_w", "m", frame="world"),
    _t("vehicle_local_position_groundtruth", "vx vy vz", "truth_vel_w", "m/s", frame="world"),
    _t(
        "vehicle_attitude_groundtruth",
        _vector("q", 4),
        "truth_quat_wb",
        "1",
        "quaternion",
        frame="world",
    ),
    _t("vehicle_rates_setpoint", "roll pitch yaw", "rate_setpoint_b", "rad/s", frame="body"),
    _t("vehicle_rates_setpoint", "thrust_body[2]", "throttle", "1", scale=-1.0),
    _t("battery_status", "voltage_v", "battery_voltage", "V"),
    _t("battery_status", "current_a", "current", "A"),
    _t("actuator_motors", _motors("control[*]"), "motor_command", "1"),
    _t("actuator_outputs", _motors("output[*]"), "motor_output", "1"),
    _t("esc_status", _motors("esc[*].esc_rpm"), "motor_speed", "rpm"),
)

DATAFLASH = (
    *(
        tap
        for core in ("XKF1", "NKF1", "EKF1")
        for tap in (
            _t(core, "PN PE PD", "pos_w", "m"),
            _t(core, "VN VE VD", "vel_w", "m/s"),
        )
    ),
    _t("ATT", "Roll Pitch Yaw", "quat_wb", "deg", "euler"),
    _t("IMU", "GyrX GyrY GyrZ", "rate_b", "rad/s"),
    _t("IMU", "AccX AccY AccZ", "acc_b", "m/s^2", frame="body"),
    _t("VISP", "PX PY PZ", "mocap_pos_w", "m", frame="world", good="Ign Q"),
    _t("VISP", "R P Y", "mocap_quat_wb", "deg", "euler", frame="world", good="Ign Q"),
    _t("VISP", "Roll Pitch Yaw", "mocap_quat_wb", "deg", "euler", frame="world", good="Ign Q"),
    _t("SIM2", "PN PE PD", "truth_pos_w", "m", frame="world"),
    _t("SIM2", "VN VE VD", "truth_vel_w", "m/s", frame="world"),
    _t("SIM", "Q1 Q2 Q3 Q4", "truth_quat_wb", "1", "quaternion", frame="world"),
    _t("RATE", "RDes PDes YDes", "rate_setpoint_b", "deg/s", frame="body"),
    _t("BAT", "Volt", "battery_voltage", "V"),
    _t("BAT", "Curr", "current", "A"),
    _t("RCOU", _motors("C+*"), "motor_output", "1"),
    _t("RCOU", _motors("Ch+*"), "motor_output", "1"),
    _t("RCOU", _motors("Chan+*"), "motor_output", "1"),
    _t("ESC", _motors("RPM[*]"), "motor_speed", "rpm"),
    _t("CTUN", "ThO", "throttle", "1"),
)

POSE_PARTS = ("pos_w", "quat_wb", "vel_w", "rate_b")
EARTH_RADIUS = 6378100.0  # ArduPilot's scale of latitude [m]
BODY_FRAME = 3  # VELOCITY_FRAME_BODY_FRD
POSE_TAPS = {
    "bin": (
        _t("POS", "N E D", "pos_w", "m"),
        *(
            _t(core, "Roll Pitch Yaw", "quat_wb", "deg", "euler")
            for core in ("XKF1", "NKF1", "EKF1")
        ),
    ),
    "ulg": tuple(
        _t(f"vehicle_{kind}", fields, channel, unit)
        for kind in ("odometry", "visual_odometry", "mocap_odometry")
        for fields, channel, unit in (
            (_vector("velocity"), "vel_w", "m/s"),
            ("vx vy vz", "vel_w", "m/s"),
            (_vector("angular_velocity"), "rate_b", "rad/s"),
            ("rollspeed pitchspeed yawspeed", "rate_b", "rad/s"),
        )
    ),
}
"""Kind of log -> fields of poses that :func:`log_of_poses` alone reads: places on the globe become
N, E, D, and a velocity may be of the body.
"""

LOCAL = ("frame_id", 1.0, 1.0)  # MAV_FRAME_LOCAL_NED
FRD, FLU = ("frame_id", 20.0, 20.0), ("frame_id", 21.0, 21.0)  # about a yaw of the sender's
MOCAP = ("frame_id", 14.0, 14.0)  # MAV_FRAME_MOCAP_NED of before 2019
TELEMETRY = (
    _t("LOCAL_POSITION_NED", "x y z", "pos_w", "m"),
    _t("LOCAL_POSITION_NED", "vx vy vz", "vel_w", "m/s"),
    *(
        tap
        for where, axes in ((LOCAL, NED), (FRD, NED), (MOCAP, NED), (FLU, "x,y,z"))
        for tap in (
            _t("ODOMETRY", "x y z", "pos_w", "m", good="quality", only=(where,), axes=axes),
            _t("ODOMETRY", _vector("q", 4), "quat_wb", "1", "quaternion", only=(where,), axes=axes),
        )
    ),
    _t("ATTITUDE_QUATERNION", "q1 q2 q3 q4", "quat_wb", "1", "quaternion"),
    _t("ATTITUDE", "roll pitch yaw", "quat_wb", "rad", "euler"),
    _t("ATTITUDE", "rollspeed pitchspeed yawspeed", "rate_b", "rad/s"),
    _t("HIGHRES_IMU", "xacc yacc zacc", "acc_b", "m/s^2", frame="body"),
    _t("SCALED_IMU", "xacc yacc zacc", "acc_b", "mg", frame="body"),
    _t("RAW_IMU", "xacc yacc zacc", "acc_b", "mg", frame="body"),
    _t("VISION_POSITION_ESTIMATE", "x y z", "mocap_pos_w", "m", frame="world"),
    _t("ATT_POS_MOCAP", "x y z", "mocap_pos_w", "m", frame="world"),
    _t("ATT_POS_MOCAP", _vector("q", 4), "mocap_quat_wb", "1", "quaternion", frame="world"),
    _t(
        "ATTITUDE_TARGET",
        "body_roll_rate body_pitch_rate body_yaw_rate",
        "rate_setpoint_b",
        "rad/s",
        frame="body",
    ),
    _t("ATTITUDE_TARGET", "thrust", "throttle", "1"),
    _t("SYS_STATUS", "voltage_battery", "battery_voltage", "mV"),
    _t("SERVO_OUTPUT_RAW", _motors("servo+*_raw"), "motor_output", "1"),
    _t("ESC_TELEMETRY_1_TO_4", _motors("rpm[*]"), "motor_speed", "rpm"),
)

FLYING: dict[str, tuple[tuple[str, str, float, float], ...]] = {
    "ulog": (("vehicle_status", "arming_state", 2, 2), ("vehicle_land_detected", "landed", 0, 0)),
    "dataflash": (("ARM", "ArmState", 1, 1), ("STAT", "isFlying", 1, 1)),
    "telemetry": (
        ("HEARTBEAT", "base_mode", 128, 255),
        ("EXTENDED_SYS_STATE", "landed_state", 2, 4),
    ),
}
"""Kind of log -> messages and fields that say whether it is armed and in the air: the least and the
largest value that does.
"""
MOTORS_ALONE = ("actuator_motors", "esc_status", "ESC")
"""Messages of motors that hold no other outputs, such as those of a gimbal."""
RESETS = tuple(f"{name}_reset_counter" for name in ("xy", "z", "vxy", "vz")) + (
    "reset_counter",
    "Rst",
    "RstCnt",
)
"""Fields that count jumps of an estimate to another origin."""

SWEEP = ("SIDS", "SIDD")
SWEEP_AXES = 7
"""Messages of ArduPilot's SYSTEMID: its settings, and the sweep [deg/s]; its axes from which on it
sweeps rates of roll, pitch, yaw.
"""

READERS = {
    ".ulg": (read_ulog, ULOG),
    ".bin": (read_dataflash, DATAFLASH),
    ".tlog": (read_telemetry, TELEMETRY),
}
"""Ending -> reader of the messages, and what they tell."""


def log_of_autopilot(path: str | Path) -> FlightLog:
    """Read the log of an autopilot, by its ending.

    Raises LogError: it cannot be read, or holds nothing of a vehicle's motion.
    """
    reader, taps = READERS[Path(path).suffix.lower()]
    tapped = {tap.message for tap in taps}
    state_messages = {message for states in FLYING.values() for message, *_ in states}
    log = reader(path, tapped | state_messages | set(SWEEP))
    vehicle = vehicle_of(log)
    _join_escs(log)
    channels: dict[str, Channel] = {}
    notes: dict[str, dict] = {}
    left_out = list(log.meta.pop("left_out", []))
    for tap in taps:
        if tap.entry.name not in channels:
            signal = _channel(tap, log, vehicle, str(path), left_out)
            if signal is not None:
                channels[tap.entry.name], notes[tap.entry.name] = signal
    left_out += _of_other_kinds(log, taps)
    _add_sweep(channels, notes, log)
    if not channels:
        raise LogError(
            f"{path}: no message of a vehicle's motion in it; known: {', '.join(sorted(tapped))}"
        )
    if (flying := _flying(log)) is not None:
        channels["flying"] = flying
    starts = [float(channel.time[0]) for channel in channels.values() if len(channel.time)]
    if not starts or not math.isfinite(min(starts)):
        raise LogError(f"{path}: stamps are not finite")
    start = min(starts)  # time counts from the first sample
    channels = {
        name: replace(channel, time=channel.time - start) for name, channel in channels.items()
    }
    meta = {"source": str(path), "start": start, "kind": log.kind, "ingest": notes, **log.meta}
    meta |= {"vehicle": vehicle.kind, "left_out": list(dict.fromkeys(left_out))}
    return FlightLog(channels, meta)


def _channel(
    tap: Tap, log: Messages, vehicle: Vehicle, source: str, left_out: list[str]
) -> tuple[Channel, dict] | None:
    """Channel of a tap and notes on it; None where the log has none of its fields."""
    columns = tap.entry.columns
    if "{0}" in "".join(columns):
        if not vehicle.motors:
            if log.first(tap.message) is not None:
                left_out.append(
                    f"{tap.message}: of a {vehicle.kind}, whose motors are not those of a"
                    " quadrotor X"
                )
            return None
        numbers = vehicle.outputs if "+" in columns[0] else vehicle.motors
        first = 1 if "+" in columns[0] else 0
        columns = tuple(
            column.replace("+", "").format(*(n + first for n in numbers)) for column in columns
        )
    chosen = _moving(log.instances(tap.message), columns, tap)
    if chosen is None:
        return None
    number, fields = chosen
    if tap.message in MOTORS_ALONE:
        count = _moving_motors(fields, tap.entry.columns[0])
        if count > len(columns):
            left_out.append(f"{tap.message}: {count} motors move, not the four of a quadrotor")
            return None
    entry = replace(tap.entry, columns=columns)
    with np.errstate(invalid="ignore"):  # damaged floats
        values = np.column_stack([fields[column] for column in columns]).astype(float)
    bad = ~in_range(fields, tap.good)
    channel, notes = make_channel(np.asarray(fields["time"], float), values, entry, source, bad)
    notes |= {"clock": "autopilot", "message": tap.message, "instance": number}
    if np.any(bad):
        notes["flagged"] = ", ".join(bounds[0] for bounds in tap.good if bounds[0] in fields)
    resets = [int(np.sum(np.diff(fields[name]) != 0)) for name in RESETS if name in fields]
    if sum(resets):
        notes["resets"] = sum(resets)
    return channel, notes


def log_of_poses(path: str | Path, kind: str, message: str, instance: int = 0) -> FlightLog:
    """Read the poses of one message of a log of kind "bin" or "ulg", whatever its ending.

    The axes stay the autopilot's: world north, east, down (PX4 optionally forward, right, down),
    body forward, right, down. The channels are pos_w, quat_wb (xyzw), vel_w, rate_b, as far as they
    are known, ``arrival`` [s] and ``resets``. A position without an attitude goes with the
    vehicle's own attitude and rates. ``together`` of the metadata names the channels that share
    the position's stamps. Without such an instance no channel is there.

    Raises LogError: it cannot be read, the message is not in it, or there is no attitude.
    """
    taps = _pose_taps(kind)
    log = READERS[f".{kind}"][0](path, {tap.message for tap in taps} | {"ORGN"})
    if message not in log.names:
        available = ", ".join(name for name in pose_messages(kind) if name in log.names)
        raise LogError(
            f"{log.path}: no {message} in this log; of the messages with poses it has:"
            f" {available or 'none'}"
        )
    data = log.fields.get((message, instance))
    if data is None:
        return FlightLog({})
    if message == "POS":
        data = data | _from_globe(data, log.first("ORGN"))
    sources = {_pose_part(tap): (tap, data) for tap in reversed(taps) if _fits(tap, message, data)}
    together = [*sources]
    if "quat_wb" not in sources:
        for tap in taps:
            fields = log.first(tap.message)
            turns = tap.entry.name in ("quat_wb", "rate_b")
            if turns and fields is not None and _fits(tap, tap.message, fields):
                sources.setdefault(tap.entry.name, (tap, fields))
        if "quat_wb" not in sources:
            raise LogError(f"{log.path}: {message} gives no attitude, and the log holds none")
    channels = {name: _of_pose(name, *source, str(path)) for name, source in sources.items()}
    counters = [data[name] for name in (*RESETS, "heading_reset_counter") if name in data]
    arrival = ChannelMap("arrival", ("arrival",), "s"), data["arrival"]
    resets = ChannelMap("resets", ("resets",), "1"), np.sum([0.0 * data["time"], *counters], axis=0)
    for entry, values in (arrival, resets):
        channels[entry.name] = make_channel(data["time"], values[:, None], entry, str(path))[0]
    return FlightLog(channels, {"source": str(path), "together": together})


def pose_messages(kind: str) -> list[str]:
    """Return the messages of a log of kind "bin" or "ulg" that hold poses."""
    return sorted({tap.message for tap in _pose_taps(kind) if _pose_part(tap) == "pos_w"})


def _pose_taps(kind: str) -> list[Tap]:
    taps = (*READERS[f".{kind}"][1], *POSE_TAPS[kind])
    return [tap for tap in taps if _pose_part(tap) in POSE_PARTS]


def _pose_part(tap: Tap) -> str:
    """Return the part of a pose that a tap holds, whoever measured or estimated it."""
    return tap.entry.name.removeprefix("mocap_").removeprefix("est_")


def _fits(tap: Tap, message: str, fields: Fields) -> bool:
    """Return whether a tap is of a message with these fields."""
    return tap.message == message and all(column in fields for column in tap.entry.columns)


def _of_pose(part: str, tap: Tap, fields: Fields, source: str) -> Channel:
    """Return a part of a pose about the autopilot's axes, without the samples that are not known;
    a position keeps those that are not valid.
    """
    values = np.column_stack([fields[column] for column in tap.entry.columns]).astype(float)
    if part == "vel_w" and "velocity_frame" in fields:
        values = _in_world(values, fields)
    entry = replace(tap.entry, name=part, axes="", body_axes="")
    channel, _ = make_channel(fields["time"], values, entry, source, ~in_range(fields, tap.good))
    return channel if part == "pos_w" else channel.only(np.asarray(channel.valid))


def _in_world(vel: np.ndarray, odometry: Fields) -> np.ndarray:
    """Return velocities in the world frame; NaN for a body's without an attitude."""
    quat = np.column_stack([odometry[f"q[{i}]"] for i in (1, 2, 3, 0)]).astype(float)
    with np.errstate(invalid="ignore"):  # of attitudes that are not known
        vel_w = rotate(quat / np.linalg.norm(quat, axis=1, keepdims=True), vel)
    return np.where((odometry["velocity_frame"] == BODY_FRAME)[:, None], vel_w, vel)


def _from_globe(data: Fields, origins: Fields | None) -> Fields:
    """Return north, east and down [m] from the estimator's origin, else from the first position."""
    lat, lng = data["Lat"][0], data["Lng"][0]
    if origins is not None and "Type" in origins:
        index = np.flatnonzero(origins["Type"] == 0.0)
        if len(index):
            lat, lng = origins["Lat"][index[-1]], origins["Lng"][index[-1]]
    return {
        "N": np.radians(data["Lat"] - lat) * EARTH_RADIUS,
        "E": np.radians(data["Lng"] - lng) * EARTH_RADIUS * math.cos(math.radians(lat)),
        "D": -(data["RelOriginAlt"] if "RelOriginAlt" in data else data["RelHomeAlt"]),
    }


def in_range(fields: Fields, ranges: tuple[Range, ...]) -> np.ndarray:
    """Whether each row has all of these fields, as far as it has them, in their range."""
    good = np.ones(len(fields["time"]), bool)
    for name, lowest, largest in ranges:
        if name in fields:
            value = np.asarray(fields[name], float)
            good &= (value >= lowest) & (value <= largest)
    return good


def _moving(
    instances: dict[int, Fields], columns: tuple[str, ...], tap: Tap
) -> tuple[int, Fields] | None:
    """Return the first instance of a message with these columns that moves, else the first."""
    candidates = []
    for number, fields in instances.items():
        if all(column in fields for column in columns):
            rows = in_range(fields, tap.only)
            if np.any(rows):
                candidates.append((number, {name: values[rows] for name, values in fields.items()}))
    moving = [
        instance
        for instance in candidates
        if any(np.ptp(np.nan_to_num(instance[1][c])) > 0.0 for c in columns)
    ]
    return next(iter([*moving, *candidates]), None)


def _of_other_kinds(log: Messages, taps: tuple[Tap, ...]) -> list[str]:
    """Messages of which every row is of a kind that no tap takes."""
    notes = []
    for message in dict.fromkeys(tap.message for tap in taps if tap.only):
        ranges = {tap.only[0] for tap in taps if tap.message == message}
        fields = log.first(message)
        if fields is not None and not any(np.any(in_range(fields, (bounds,))) for bounds in ranges):
            name = next(iter(ranges))[0]
            received = ", ".join(f"{value:g}" for value in np.unique(fields[name]))
            accepted = ", ".join(f"{lowest:g}" for _, lowest, _ in sorted(ranges))
            notes.append(f"{message}: its {name} is {received}; those that are read: {accepted}")
    return notes


def _moving_motors(fields: Fields, pattern: str) -> int:
    """Count the motors of a message that move, named by a pattern such as
    ``control[{0}]``, move.
    """
    names = [pattern.format(number) for number in range(16)]
    return sum(np.ptp(np.nan_to_num(fields[name])) > 0.0 for name in names if name in fields)


def _join_escs(log: Messages) -> None:
    """Speeds of ArduPilot's ESC messages, one an instance, on the stamps of the first, in place."""
    escs = {i: instance for i, instance in log.instances("ESC").items() if "RPM" in instance}
    if not escs:
        return
    time = next(iter(escs.values()))["time"]
    speeds = {
        f"RPM[{i}]": np.interp(time, instance["time"], instance["RPM"])
        for i, instance in escs.items()
    }
    log.fields["ESC", min(escs)] = {"time": time, **speeds}


def _flying(log: Messages) -> Channel | None:
    """Whether the vehicle is armed and in the air; None where the log does not say."""
    signals = []
    for message, field, lowest, largest in FLYING[log.kind]:
        fields = log.first(message)
        if fields is not None and field in fields:
            order = np.argsort(fields["time"], kind="stable")
            signals.append(
                (fields["time"][order], in_range(fields, ((field, lowest, largest),))[order])
            )
    if not signals:
        return None
    time = np.unique(np.concatenate([time for time, _ in signals]))
    flying = np.ones(len(time), bool)
    for times, good in signals:
        flying &= good[np.maximum(np.searchsorted(times, time, side="right") - 1, 0)]
    return Channel(time, flying, "bool", "none")


def _add_sweep(channels: dict, notes: dict, log: Messages) -> None:
    """Add a sweep of ArduPilot's SYSTEMID to the commanded rate of its axis, which the log tells
    without it.
    """
    started = log.first(SWEEP[0])
    sweep = log.first(SWEEP[1])
    rates = channels.get("rate_setpoint_b")
    if started is None or sweep is None or rates is None:
        return
    axis = int(np.asarray(started["Ax"])[-1]) - SWEEP_AXES
    if not 0 <= axis < 3:
        return
    time = np.asarray(sweep["time"], float)
    size = np.radians(np.asarray(sweep["Targ"], float))
    added = np.interp(rates.time, time, size, left=0.0, right=0.0) * (1.0 if axis == 0 else -1.0)
    values = rates.values.copy()
    values[:, axis] += added
    channels["rate_setpoint_b"] = replace(rates, values=values)
    notes["rate_setpoint_b"] |= {
        "sweep": f"SIDD about axis {axis}, {time[0]:.1f} to {time[-1]:.1f} s"
    }
