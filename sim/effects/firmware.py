"""Conversion of Betaflight's settings, as its blackbox logs them, to the rate controller
``motor_mixing``.

Source: betaflight 4.6, src/main/flight/pid.h (PTERM_SCALE, ITERM_SCALE, DTERM_SCALE,
FEEDFORWARD_SCALE, PID_MIXER_SCALING), pid.c (applyItermRelax), pid_init.c, mixer.c
(applyMixToMotors), src/main/blackbox/blackbox.c (names and units of the header)."""

import dataclasses
import math
from collections.abc import Mapping, Sequence

from sim.params import ControllerParams, VehicleParams

P_SCALE = 0.032029
I_SCALE = 0.244381
D_SCALE = 0.000529
F_SCALE = 0.013754
MIXER_SCALE = 1000.0
"""Output of a setting of 1 for an error of 1 deg/s (P), 1 deg (I), 1 deg/s^2 (D) and a feed-forward
of 1 deg/s^2; output that equals a motor's full command.
"""

YAW_I = 2.5  # factor on the I setting about yaw (pid_init.c, pidInitConfig)

DEGREE = math.degrees(1.0)

NOT_SAID = {
    "rc_smoothing": "smooths the set-point by three low-passes",
    "tpa_rate": "takes D back with the throttle",
    "anti_gravity_gain": "adds to P and I where the throttle moves",
    "throttle_boost": "adds to the throttle where it moves",
    "gyro_lpf1_dyn_hz": "opens the gyro's filter with the throttle",
    "dterm_lpf1_dyn_hz": "opens the filter of D with the throttle",
    "d_max": "raises D in fast moves",
    "thrust_linear": "bends the mixer's output",
    "vbat_sag_compensation": "raises the output as the battery sags",
    "dshot_bidir": "idles by the rotors' speed",
    "yaw_lowpass_hz": (
        "smooths P of yaw: of the gyro's part the block has the lag, of the command's none"
    ),
}
"""Setting that the block does not model -> its effect if it is not 0."""


def numbers(settings: Mapping[str, str], name: str, default: str = "0") -> list[float]:
    """Return the numbers of a setting, such as ``rollPID:11,20,8``."""
    return [float(word) for word in settings.get(name, default).split(",")]


def missing_features(settings: Mapping[str, str]) -> list[str]:
    """List the firmware's features under these settings that the block lacks."""
    features = []
    for name, does in NOT_SAID.items():
        values = numbers(settings, name)
        plain = numbers(settings, "rollPID")[2:] + numbers(settings, "pitchPID")[2:]
        if name == "d_max" and any(values):
            filters = values[:2] != plain
        else:
            filters = name != "d_max" and values[0] > 0.0
        features += [f"{name} {settings[name]}: {does}"] if filters else []
    return features


def calibrated_voltage(
    vehicle: VehicleParams, settings: Mapping[str, str], weight: float, hover: float
) -> float:
    """Return the voltage [V] at which a motor's thrust at the throttle ``hover``, 0 to 1, equals
    ``weight`` [N], according to the vehicle's thrust map.
    """
    idle = numbers(settings, "motor_idle")[0] * 1e-4
    full = weight / (idle + (1.0 - idle) * hover) ** 2
    return vehicle.battery.reference_voltage * math.sqrt(full / vehicle.controller.max_thrust)


NEEDED = (
    "rollPID",
    "pitchPID",
    "yawPID",
    "ff_weight",
    "iterm_relax_cutoff",
    "motor_idle",
    "pidsum_limit",
    "iterm_windup",
)
"""Required settings. Filters that are not among the settings count as off."""


def _lag(settings: Mapping[str, str], *names: str) -> float:
    """Return the delay of low-passes in series [s]; 0 Hz means off."""
    cutoffs = [numbers(settings, name)[0] for name in names]
    return sum(1.0 / (2.0 * math.pi * hz) for hz in cutoffs if hz > 0.0)


def _torques(vehicle: VehicleParams, thrust: float) -> list[float]:
    """Return the torques about the axes for an output of 1 per degree [N m].

    ``thrust``: of a motor for its full command, by linearisation [N].
    """
    rotors = vehicle.rotors
    arms = (sum(map(abs, rotors.y)), sum(map(abs, rotors.x)), 4.0 * vehicle.thrust.torque_ratio)
    return [arm * thrust / MIXER_SCALE * DEGREE for arm in arms]


def _gains(
    torques: list[float], scale: float, values: Sequence[float]
) -> tuple[float, float, float]:
    """Return the gains, or limits [N m], of the three axes."""
    x, y, z = (scale * value * torque for value, torque in zip(values, torques, strict=True))
    return x, y, z


def controller_of(
    vehicle: VehicleParams, settings: Mapping[str, str], mix_thrust: float, voltage: float
) -> ControllerParams:
    """Compute the parameters of ``motor_mixing``. Raises ValueError: a setting is missing.

    Args:
        vehicle: with the rotors that the firmware drives; its ``max_thrust`` applies at the
            battery's reference voltage.
        settings: by their names in the blackbox's header: rollPID, pitchPID, yawPID, ff_weight,
            iterm_relax_cutoff, motor_idle, gyro_lpf1_static_hz, gyro_lpf2_static_hz,
            dterm_lpf1_static_hz, dterm_lpf2_static_hz, yaw_lowpass_hz, pidsum_limit, iterm_windup.
        mix_thrust: of a motor in hover [N].
        voltage: at which the throttle was calibrated [V].
    """
    missing = [name for name in NEEDED if name not in settings]
    if missing:
        raise ValueError(
            f"settings without {', '.join(missing)}; expected those of a blackbox's header, such as"
            " rollPID:45,80,40"
        )
    c = vehicle.controller
    full = c.max_thrust * (voltage / vehicle.battery.reference_voltage) ** 2
    idle = numbers(settings, "motor_idle")[0] * 1e-4
    thrust = 2.0 * math.sqrt(mix_thrust * full) * (1.0 - idle)  # slope over the command [N]
    torques = _torques(vehicle, thrust)
    p, i, d, *_ = zip(*[numbers(settings, f"{axis}PID") for axis in ("roll", "pitch", "yaw")])
    forward = numbers(settings, "ff_weight")
    extremes = [
        numbers(settings, name, settings["pidsum_limit"])[0]
        for name in ("pidsum_limit", "pidsum_limit", "pidsum_limit_yaw")
    ]
    windup = 0.01 * numbers(settings, "iterm_windup")[0] / DEGREE

    gyro = _lag(settings, "gyro_lpf1_static_hz", "gyro_lpf2_static_hz")
    whole = gyro + _lag(settings, "dterm_lpf1_static_hz", "dterm_lpf2_static_hz")
    share, yaw_share = (
        (gyro + filtering) / whole if whole > 0.0 else 1.0
        for filtering in (0.0, _lag(settings, "yaw_lowpass_hz"))
    )
    return dataclasses.replace(
        c,
        kind="motor_mixing",
        p_gain=_gains(torques, P_SCALE, p),
        i_gain=_gains(torques, I_SCALE, (*i[:2], YAW_I * i[2])),
        d_gain=_gains(torques, D_SCALE, d),
        feedforward_gain=_gains(torques, F_SCALE, forward),
        integral_limit=_gains(torques, windup, extremes),
        setpoint_time_constant=_lag(settings, "iterm_relax_cutoff"),
        gyro_time_constant=whole,
        gyro_share=(share, share, yaw_share),
        min_thrust=full * idle**2,
        max_thrust=full,
        voltage_compensation=0.0,
        mix_thrust=mix_thrust,
        calibration_voltage=voltage,
    )
