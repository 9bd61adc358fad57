"""Logs of autopilots as flight logs:

PX4's ULog, ArduPilot's DataFlash (.BIN) and MAVLink telemetry (.tlog).

All of them are north-east-down and forward-right-down; ours become x north, y west, z up and
forward, left, up."""

import math
from dataclasses import replace
from pathlib import Path

import numpy as np

from visthrow.common.errors import LogError
from visthrow.logs.flightlog import FlightLog
from visthrow.logs.mapping import ChannelMap
from visthrow.logs.readers.messages import Messages, read_dataflash, read_telemetry, read_ulog
from visthrow.logs.readers.table import make_channel

NED = "x,-y,-z"  # our axes in the autopilot's, world and body alike


def _t(
    message: str, fields: str, channel: str, unit: str, kind: str = "vector", **more
) -> tuple[str, ChannelMap]:
    """Fields of one kind of message that make a channel; of those to one channel the first that is
    there is used.
    """
    columns, turned = tuple(fields.split()), kind != "vector"
    axes = NED if turned or len(columns) == 3 else ""
    order = "wxyz" if kind == "quaternion" else "xyzw"
    return message, ChannelMap(
        channel, columns, unit, kind, order, axes=axes, body_axes=NED if turned else "", **more
    )


ULOG = (
    _t("vehicle_local_position", "x y z", "pos_w", "m"),
    _t("vehicle_local_position", "vx vy vz", "vel_w", "m/s"),
    _t("vehicle_attitude", "q[0] q[1] q[2] q[3]", "quat_wb", "1", kind="quaternion"),
    _t("vehicle_angular_velocity", "xyz[0] xyz[1] xyz[2]", "rate_b", "rad/s"),
    _t("sensor_combined", "gyro_rad[0] gyro_rad[1] gyro_rad[2]", "rate_b", "rad/s"),
    _t(
        "sensor_combined",
        "accelerometer_m_s2[0] accelerometer_m_s2[1] accelerometer_m_s2[2]",
        "acc_b",
        "m/s^2",
        frame="body",
    ),
    _t(
        "vehicle_visual_odometry",
        "position[0] position[1] position[2]",
        "mocap_pos_w",
        "m",
        frame="world",
    ),
    _t(
        "vehicle_visual_odometry",
        "q[0] q[1] q[2] q[3]",
        "mocap_quat_wb",
        "1",
        kind="quaternion",
        frame="world",
    ),
    _t("vehicle_rates_setpoint", "roll pitch yaw", "rate_setpoint_b", "rad/s", frame="body"),
    _t("vehicle_rates_setpoint", "thrust_body[2]", "throttle", "1", scale=-1.0),
    _t("battery_status", "voltage_v", "battery_voltage", "V"),
    _t("battery_status", "current_a", "current", "A"),
    _t("actuator_motors", "control[2] control[0] control[1] control[3]", "motor_command", "1"),
    _t("actuator_outputs", "output[2] output[0] output[1] output[3]", "motor_output", "1"),
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
    _t("BAT", "Volt", "battery_voltage", "V"),
    _t("BAT", "Curr", "current", "A"),
    _t("RCOU", "C3 C1 C2 C4", "motor_output", "1"),
    _t("CTUN", "ThO", "throttle", "1"),
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
    _t(
        "ATTITUDE_TARGET",
        "body_roll_rate body_pitch_rate body_yaw_rate",
        "rate_setpoint_b",
        "rad/s",
        frame="body",
    ),
    _t("ATTITUDE_TARGET", "thrust", "throttle", "1"),
    _t("SYS_STATUS", "voltage_battery", "battery_voltage", "mV"),
    _t("SERVO_OUTPUT_RAW", "servo3_raw servo1_raw servo2_raw servo4_raw", "motor_output", "1"),
)

SWEEP, SWEEP_AXES = ("SIDS", "SIDD"), 7
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
    found = reader(path, {message for message, _ in taps} | set(SWEEP))
    channels, notes = {}, {}
    for message, entry in taps:
        fields = found.first(message)
        if (
            fields is None
            or entry.name in channels
            or not all(column in fields for column in entry.columns)
        ):
            continue
        with np.errstate(invalid="ignore"):  # damaged floats
            values = np.column_stack([fields[column] for column in entry.columns]).astype(float)
        channels[entry.name], noted = make_channel(
            np.asarray(fields["time"], float), values, entry, str(path)
        )
        notes[entry.name] = noted | {"clock": "autopilot", "message": message}
    _add_sweep(channels, notes, found)
    starts = [float(channel.time[0]) for channel in channels.values() if len(channel.time)]
    if not starts:
        known = ", ".join(sorted({message for message, _ in taps}))
        raise LogError(f"{path}: no message of a vehicle's motion in it; known: {known}")
    start = min(starts)  # time counts from the first sample
    if not math.isfinite(start):
        raise LogError(f"{path}: stamps are not finite")
    channels = {
        name: replace(channel, time=channel.time - start) for name, channel in channels.items()
    }
    meta = {"source": str(path), "start": start, "kind": found.kind, "ingest": notes, **found.meta}
    return FlightLog(channels, meta)


def _add_sweep(channels: dict, notes: dict, found: Messages) -> None:
    """Add a sweep of ArduPilot's SYSTEMID to the commanded rate of its axis, which the log tells
    without it.
    """
    started, sweep, rates = (
        found.first(SWEEP[0]),
        found.first(SWEEP[1]),
        channels.get("rate_setpoint_b"),
    )
    if started is None or sweep is None or rates is None:
        return
    axis = int(np.asarray(started["Ax"])[-1]) - SWEEP_AXES
    if not 0 <= axis < 3:
        return
    time, size = np.asarray(sweep["time"], float), np.radians(np.asarray(sweep["Targ"], float))
    added = np.interp(rates.time, time, size, left=0.0, right=0.0) * (1.0 if axis == 0 else -1.0)
    values = rates.values.copy()
    values[:, axis] += added
    channels["rate_setpoint_b"] = replace(rates, values=values)
    notes["rate_setpoint_b"] |= {
        "sweep": f"SIDD about axis {axis}, {time[0]:.1f} to {time[-1]:.1f} s"
    }
