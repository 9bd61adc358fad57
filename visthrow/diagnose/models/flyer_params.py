"""Parameters of a quadrotor that is driven by its logged commands and its measured attitude (the table ``flyer`` of a file of
``configs/diagnose``), and the catalogue of its effects.
"""

from dataclasses import dataclass
from typing import Literal

import numpy as np

from visthrow.common.errors import ConfigError
from visthrow.diagnose.models.interface import Effect

MOST_LATE = 0.15
"""By which attitudes may be late or early [s]."""
MOTORS = {"fl": "front left", "fr": "front right", "rl": "rear left", "rr": "rear right"}
_SCALE = ("hover with and without a weighed load",)
_YAW = ("hover at two yaw angles half a turn apart",)


@dataclass(frozen=True)
class CableParams:
    """Payload on a massless cable at the vehicle's centre of mass."""

    length: float  # to the payload's centre [m]
    mass: float  # of the payload [kg]


@dataclass(frozen=True)
class TorqueParams:
    """What turns commands of single motors into rates."""

    inertia: tuple[float, float, float]  # [kg m^2]
    arm_x: float  # of each rotor from the centre of mass, along x and along y [m]
    arm_y: float
    torque_ratio: float  # drag torque over thrust [m]
    spin: tuple[float, float, float, float]  # +1 turns clockwise seen from above; order of the rotors as everywhere


@dataclass(frozen=True)
class FlyerParams:
    """The vehicle that is assumed before anything is found.

    Raises:
        ConfigError: ``input`` names no channel that commands come from, or the thrust map does not rise.
    """

    input: Literal["motor_command", "motor_speed", "thrust_command", "command"]  # channel of the commands
    position: str  # channel of the measured position
    attitude: str  # channel of the measured attitude
    mass: float  # of the vehicle alone [kg]
    gravity: float  # [m/s^2]
    thrust_map: tuple[float, float, float]  # thrust of a motor (of all, for a thrust command) by powers 0, 1, 2 of its input [N]
    motor_time_constant: float  # [s]
    command_delay: float  # [s]
    reference_voltage: float  # at which the map holds [V]
    voltage_coefficient: float  # thrust changes by this share a volt [1/V]
    drag_xy: float  # rotor drag [kg/s]
    drag_z: float  # [kg/s]
    lowest: float  # windows keep above this height [m]
    window: float  # [s]
    step: float  # of the integration [s]
    every: int  # the position samples taken: each so-manieth
    most_windows: int  # spread evenly over all logs
    estimator_rate: float = 1.0  # at which an estimate of the attitude takes other forces than thrust for tilt [1/s]
    torque: TorqueParams | None = None  # None: rates are not simulated
    cable: CableParams | None = None  # None: no payload

    @property
    def total_mass(self) -> float:
        """Of vehicle and payload [kg]."""
        return self.mass + (self.cable.mass if self.cable is not None else 0.0)

    def thrust(self, told: np.ndarray) -> np.ndarray:
        """What the map gives for inputs [N]."""
        return sum(c * told**power for power, c in enumerate(self.thrust_map))

    def __post_init__(self) -> None:
        if self.torque is not None and self.input not in ("motor_command", "motor_speed"):
            raise ConfigError(f"torque needs commands of single motors; the input is '{self.input}'")
        if self.thrust_map[1] <= 0.0 and self.thrust_map[2] <= 0.0:
            raise ConfigError(f"thrust_map {self.thrust_map} does not rise")


def effects_of(params: FlyerParams, has_voltage: bool) -> list[Effect]:
    """Entries that apply, with priors in proportion to the vehicle's weight where a force is meant."""
    seen = (params.position, params.attitude, params.input)
    found = [*_thrust(params, seen), *_aero(params, seen), *_sensing(params, seen)]
    if not has_voltage:
        found.append(
            Effect("thrust_fade", "the thrust's change through a flight", "T (1 + theta t), t since the log's begin", "1/s", "battery",
                   (-0.02, 0.02), 2e-3, 2e-5, seen, "packs and motors that warm", ("thrust_gain",), ("a long hover",))
        )  # fmt: skip
    if params.torque is not None:
        found += _torque(params, (params.input, "rate_b"))
    if params.cable is not None:
        found += _cable(params, (*seen, "payload_pos_w"))
    return found


def _thrust(params: FlyerParams, seen: tuple[str, ...]) -> list[Effect]:
    return [
        Effect("thrust_gain", "the thrust map's scale", "T (1 + theta)", "1", "thrust map", (-0.6, 0.6), 0.1, 2e-3, seen,
               "Agilicious 2022", ("mass_quad",), _SCALE),
        Effect("thrust_curve", "the thrust map's shape", "T (1 + theta (T / T_hover - 1))", "1", "thrust map", (-0.8, 0.8), 0.1,
               1e-2, seen, "arXiv 2404.07837", (), ("thrust steps",)),
        Effect("motor_tau", "the motors' lag", "T' = (T* - T) / (tau + theta)", "s", "motor",
               (-params.motor_time_constant, 0.2), 0.02, 1e-3, seen, "arXiv 2404.07837", ("cmd_delay",), ("thrust steps",)),
        Effect("cmd_delay", "the time from the logged command to the motors", "u(t - delay - theta)", "s", "command queue",
               (-0.1, 0.2), 0.02, 1e-3, seen, "Kaufmann et al. 2023", ("motor_tau", "pose_delay"), ("thrust steps",)),
        Effect("mass_quad", "the vehicle's mass", "m + theta", "kg", "rigid body", (-0.3 * params.mass, 0.5 * params.mass),
               0.05 * params.mass, 1e-3 * params.mass, seen, "a scale", ("thrust_gain",), _SCALE),
        Effect("battery_sag", "the thrust's dependence on the battery voltage", "T (1 + theta (u - u_ref))", "1/V", "battery",
               (-1.0, 1.0), 0.1, 5e-3, (*seen, "battery_voltage"), "Bauersfeld and Scaramuzza 2022", ("thrust_gain",),
               ("fresh and empty pack, A-B-A",)),
    ]  # fmt: skip


def _aero(params: FlyerParams, seen: tuple[str, ...]) -> list[Effect]:
    weight = params.mass / 0.21  # the table's priors are those of a 0.21 kg vehicle
    return [
        Effect("rotor_drag_xy", "rotor drag across the shafts", "F -= theta (v_x, v_y, 0)", "kg/s", "aero",
               (-params.drag_xy, 1.5 * weight), 0.05 * weight, 2e-3 * weight, seen, "Faessler et al. 2018", ("parasitic",),
               ("fly there and back", "speed sweep")),
        Effect("rotor_drag_z", "rotor drag along the shafts", "F -= theta (0, 0, v_z)", "kg/s", "aero",
               (-params.drag_z, 1.5 * weight), 0.05 * weight, 5e-3 * weight, seen, "Faessler et al. 2018", (), ("vertical sine",)),
        Effect("parasitic", "the body's air drag", "F -= theta |v| v", "kg/m", "aero", (0.0, 0.2 * weight),
               0.01 * weight, 1e-3 * weight, seen, "NeuroBEM 2021", ("rotor_drag_xy",), ("speed sweep",)),
        Effect("translational_lift", "more thrust in level flight", "T (1 + theta v_xy^2)", "s^2/m^2", "aero", (-0.2, 0.2), 0.01,
               1e-3, seen, "Svacha et al. 2017", (), ("level passes at several speeds",)),
        *(Effect(f"wind_{axis}", f"air that moves along the world's {axis} axis", f"drag of v - theta e_{axis}", "m/s", "environment",
                 (-10.0, 10.0), 0.5, 0.03, seen, "Faessler et al. 2018", (f"frame_tilt_{other}", "marker_rot_x", "marker_rot_y"), _YAW)
          for axis, other in ("xy", "yx")),
    ]  # fmt: skip


def _sensing(params: FlyerParams, seen: tuple[str, ...]) -> list[Effect]:
    found = [
        Effect("pose_delay", "the delay of the measured position", "y(t) = x(t - theta)", "s", "sensing", (-0.1, 0.1), 5e-3, 5e-4,
               seen, "motion capture pipelines", ("cmd_delay",), ()),
        Effect("attitude_delay", "the delay of the measured attitude", "R_meas(t) = R(t - theta)", "s", "sensing",
               (-MOST_LATE, MOST_LATE), 1e-2, 1e-3, seen, "streams of several clocks", ("pose_delay", "cmd_delay"), ("quick turns",)),
        Effect("estimator_lean", "an attitude estimate that takes forces level with the rotors for tilt", "R = R_meas (1 + theta [a])",
               "1", "sensing", (0.0, 2.0), 0.5, 0.02, (*seen, "acc_b", "rate_b"), "Mueller, Hamer and D'Andrea 2015",
               ("payload_drag", "rotor_drag_xy"), ("attitude from several markers",)),
    ]  # fmt: skip
    for axis in "xy":
        found += [
            Effect(f"frame_tilt_{axis}", f"the capture's frame is turned about its {axis} axis",
                   f"gravity seen turned by theta about {axis}", "rad", "sensing", (-0.15, 0.15), 0.0175, 4e-4, seen,
                   "wand calibration", ("marker_rot_x", "marker_rot_y"), _YAW),
            Effect(f"marker_rot_{axis}", f"the measured attitude is turned about the body's {axis} axis",
                   f"R_meas = R R_{axis}(-theta)", "rad", "sensing", (-0.15, 0.15), 0.0175, 6e-4, seen, "marker placement",
                   ("frame_tilt_x", "frame_tilt_y"), _YAW),
        ]  # fmt: skip
    found += [
        Effect(f"marker_{axis}", f"the tracked point lies off the centre of mass along {axis}", "p_meas = p + R c", "m", "sensing",
               (-0.05, 0.05), 5e-3, 5e-4, seen, "marker placement", (), ("flips and turns",))
        for axis in "xyz"
    ]  # fmt: skip
    return found


def _torque(params: FlyerParams, seen: tuple[str, ...]) -> list[Effect]:
    of = params.torque
    return [
        *(Effect(f"motor_{key}", f"the {words} motor's thrust", "f_i (1 + theta)", "1", "thrust map", (-0.6, 0.6), 0.05, 3e-3,
                 seen, "fault detection literature", ("com_x", "com_y"), ("yaw response",)) for key, words in MOTORS.items()),
        *(Effect(f"com_{axis}", f"the centre of mass lies off the middle of the rotors along {axis}", "torque = r x T", "m",
                 "rigid body", (-0.5 * of.arm_x, 0.5 * of.arm_x), 0.05 * of.arm_x, 2e-3 * of.arm_x, seen, "build",
                 ("motor_fl", "motor_fr", "motor_rl", "motor_rr"), ("thrust steps",)) for axis in "xy"),
        Effect("inertia_xy", "the inertia in roll and pitch", "J_xy (1 + theta)", "1", "rigid body", (-0.6, 2.0), 0.2, 2e-2, seen,
               "Rucker and Wensing 2022", (), ("rate doublets",)),
        Effect("inertia_z", "the inertia in yaw, or the rotors' drag torque", "J_z (1 + theta)", "1", "rigid body", (-0.6, 2.0),
               0.2, 2e-2, seen, "Rucker and Wensing 2022", (), ("yaw doublets",)),
    ]  # fmt: skip


def _cable(params: FlyerParams, seen: tuple[str, ...]) -> list[Effect]:
    of = params.cable
    return [
        Effect("rope_length", "the cable's length", "|p_p - p_q| = L + theta", "m", "rope", (-0.5 * of.length, of.length),
               0.06 * of.length, 1.5e-3 * of.length, seen, "tape measure", ("marker_z",), ("swing",)),
        Effect("mass_payload", "the payload's mass", "m_p + theta", "kg", "rope", (-0.9 * of.mass, 5.0 * of.mass), 0.1 * of.mass,
               1e-2 * of.mass, seen, "a scale", ("thrust_gain", "mass_quad"), _SCALE),
        Effect("payload_drag", "the payload's air drag", "F_p -= theta |v| v", "kg/m", "payload aero", (0.0, 2e-2), 1e-3, 1e-4,
               seen, "Cross and Lindsey 2014", (), ("fast swing",)),
        Effect("payload_delay", "the delay of the payload's pose", "y(t) = x(t - theta)", "s", "sensing", (-0.1, 0.1), 1e-2, 1e-3,
               seen, "motion capture pipelines", ("pose_delay",), ("swing",)),
    ]  # fmt: skip
