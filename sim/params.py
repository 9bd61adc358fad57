"""Physical parameters of the vehicle, the rope and the release: frozen dataclasses, SI units.

Each dataclass is the schema of a TOML file or table of ``configs/``. Its docstring states the
equations of its fields. The blocks of ``sim/kernels/quadrotor`` and ``sim/kernels/rope`` implement
them in Warp; ``sim/reference`` is an independent implementation in float64. Units are in brackets.
Unless stated otherwise, vectors are in the body frame (x forward, y left, z up) with the origin at
the vehicle's centre of mass."""

import math
from collections.abc import Mapping
from dataclasses import dataclass, replace
from difflib import get_close_matches
from typing import Any, Literal, TypeVar

from camera.field_bounds import (
    AirCoefficient,
    Arm,
    BoundedFields,
    Drag,
    Duration,
    Lag,
    Length,
    Mass,
    NotNegative,
    NotNegativeVector,
    Positive,
    Share,
    Vector,
)
from sim.law_factors import LAW_FACTORS

GRAVITY = 9.81
"""Acceleration of free fall in every plant [m/s^2]."""

Owner = TypeVar("Owner")


def change_values(owner: Owner, values: Mapping[str, Any]) -> Owner:
    """Return a copy of a dataclass with new values at dotted paths, such as
    ``vehicle.queue.delay``. If ``values`` also holds the table of a path, that table is changed.
    """
    fields: dict[str, Any] = {}
    tables: dict[str, dict[str, Any]] = {}
    for path, value in values.items():
        name, _, inner = path.partition(".")
        if inner:
            tables.setdefault(name, {})[inner] = value
        else:
            fields[name] = value
    for name, inner_values in tables.items():
        fields[name] = change_values(fields.get(name, getattr(owner, name)), inner_values)
    return replace(owner, **fields)  # type: ignore[type-var]


LEAST_GYRATION = 0.01  # smallest radius of gyration over the reach of the rotors [-]


@dataclass(frozen=True)
class BodyParams(BoundedFields):
    """Rigid body of the vehicle, rotors included.

    ``m v' = R F_b + m g``, ``J w' = tau_b - w x J w``.
    """

    mass: Mass  # [kg]
    # principal moments about the centre of mass [kg m^2]
    inertia: tuple[Positive, Positive, Positive]
    com: Vector = (0.0, 0.0, 0.0)  # see VehicleParams [m]


@dataclass(frozen=True)
class RotorParams(BoundedFields):
    """Geometry of the four rotors.

    Rotor i is at ``r_i = (x_i, y_i, z)`` and has spin ``s_i``. With +1 it turns clockwise seen from
    above, so that its drag torque on the body points along +z."""

    x: tuple[Arm, Arm, Arm, Arm]  # [m]
    y: tuple[Arm, Arm, Arm, Arm]  # [m]
    z: Arm  # height of the rotor plane above the centre of mass [m]
    spin: tuple[float, float, float, float]  # s_i, +1 or -1
    radius: Length  # propeller radius [m]
    inertia: NotNegative  # J_r of one propeller and bell about its shaft [kg m^2]


@dataclass(frozen=True)
class QueueParams(BoundedFields):
    """Command queue: a command of time t acts from t + delay until the next one (zero-order
    hold).
    """

    delay: Lag  # tau_d, transmission and actuation [s]


@dataclass(frozen=True)
class ControllerParams(BoundedFields):
    """Body-rate controller.

    ``betaflight``: with the delayed command (c, w_cmd), measured rate w, filtered set-point r,
    filtered gyro g, integral i (a torque):

    - ``r' = (w_cmd - r) / setpoint_time_constant``
    - ``g' = (w - g) / gyro_time_constant``
    - ``tau = p_gain (r - w) + i - d_gain g' + feedforward_gain r'``  (per axis, [N m])
    - ``i' = i_gain (r - w)``. If this increases the integral (``i' i > 0``), it is 0 at ``|i| >=
      integral_limit`` and otherwise scaled by the share of the demanded torque that the mixer
      delivers: for roll and pitch their common scale, for yaw clipped over demanded. (This is
      continuous in the state; a hard hold during saturation would make trajectories depend on the
      step.)

    Mixer: per-motor thrusts ``f_i = c/4 + roll_i + pitch_i + yaw_i`` with ``roll_i = tau_x y_i / (4
    ybar^2)``, ``pitch_i = -tau_y x_i / (4 xbar^2)``, ``yaw_i = tau_z s_i / (4 kappa)`` (``ybar^2``
    mean of y_i^2, ``xbar^2`` of x_i^2, kappa the nominal torque-to-thrust ratio). With D = f_max -
    f_min: roll+pitch are scaled by D / range if their range exceeds D; then yaw is clipped to the
    remaining range; then the collective is shifted so that every f_i is in [f_min, f_max].
    ``f_max = max_thrust (u / u_ref)^2`` follows the battery voltage u. Motor-speed set-point:
    ``Omega* = sqrt(f_i / k_f) (1 + (1 - voltage_compensation) (u / u_ref - 1))``.

    ``motor_mixing`` (Betaflight's firmware, without set-point smoothing): g has the lag of the D
    term and its filters. P and I have a share of this lag, ``e = w_cmd - w - gyro_share (g - w)``.
    r is used only for ``iterm_relax``, which holds the integral of roll and pitch during a change
    of the command: ``i' = i_gain e max(0, 1 - |w_cmd - r| / relax_threshold)``, or 0 at the limit
    if i would grow. The mixer adds to motor commands: with ``u_c = sqrt(c / (4 max_thrust))`` and
    m_i the thrust of a motor for tau by the mixer above, ``u_i = u_c + m_i / (2 sqrt(mix_thrust
    max_thrust))``. All m_i are scaled if their range exceeds the range from idle ``sqrt(min_thrust
    / max_thrust)`` to 1, then u_c is shifted so that every u_i is in this range. The gains are
    exact at a thrust of ``mix_thrust`` per motor; the loop gain is proportional to the square root
    of thrust. ``Omega* = u_i sqrt(max_thrust / k_f)``, times the voltage factor above with
    ``calibration_voltage`` in place of u_ref. Source: betaflight 4.6, src/main/flight/pid.c
    (applyItermRelax), mixer.c (applyMixerAdjustment).

    ``geometric`` (the ablation): ``tau = geometric_gain J (w_cmd - w) + w x J w`` without filters,
    integral or voltage; each f_i is clipped to [f_min, max_thrust]; ``Omega* = sqrt(f_i / k_f)``.
    """

    kind: Literal["betaflight", "motor_mixing", "geometric"]
    p_gain: NotNegativeVector  # [N m s/rad]
    i_gain: NotNegativeVector  # [N m/rad]
    d_gain: NotNegativeVector  # [N m s^2/rad]
    feedforward_gain: NotNegativeVector  # [N m s^2/rad]
    integral_limit: NotNegativeVector  # [N m]
    setpoint_time_constant: Duration  # [s]
    gyro_time_constant: Duration  # [s]
    min_thrust: NotNegative  # f_min of a motor, at idle [N]
    max_thrust: Positive  # f_max of a motor, at u_ref [N]
    voltage_compensation: float  # 0: none, 1: full [-]
    geometric_gain: NotNegative  # [1/s]
    # thrust of a motor at which the gains of ``motor_mixing`` are exact [N]: hover with the payload
    mix_thrust: Positive = 0.667
    # voltage at which ``motor_mixing`` delivers the commanded thrust [V]
    calibration_voltage: Positive = 15.2
    # threshold of iterm_relax, ITERM_RELAX_SETPOINT_THRESHOLD: 40 deg/s [rad/s]
    relax_threshold: Positive = 0.698
    # share of the lag of g in P and I of ``motor_mixing`` [-]
    gyro_share: NotNegativeVector = (1.0, 1.0, 1.0)


@dataclass(frozen=True)
class MotorParams(BoundedFields):
    """Motor speed:

    ``Omega' = (Omega* - Omega) / time_constant`` (``first_order``) or ``Omega = Omega*``
    (``instant``).

    ``asymmetric``: first order, with ``time_constant_down`` if the set-point is below the speed."""

    kind: Literal["first_order", "instant", "asymmetric"]
    time_constant: Positive  # [s]
    time_constant_down: NotNegative = 0.0  # of slowing down, only for ``asymmetric`` [s]


@dataclass(frozen=True)
class BatteryParams(BoundedFields):
    """Battery.

    State: fraction used q, terminal voltage u. Electrical power ``P = P_0 + sum_i |tau_i| Omega_i /
    efficiency`` with ``tau_i`` the aerodynamic rotor torque ``kappa f_i``; current ``I = P / u``;
    ``q' = I / (3600 capacity)``; open-circuit voltage ``u_oc = ocv[0] + ocv[1] q + ocv[2] q^2 +
    ocv[3] q^3``; ``u' = (u_oc - resistance I - u) / time_constant`` (``sag``). ``ideal``: u =
    u_ref, q = 0 always."""

    kind: Literal["sag", "ideal"]
    capacity: Positive  # [A h]
    ocv: tuple[float, float, float, float]  # polynomial in the used fraction [V]
    resistance: NotNegative  # [Ohm]
    time_constant: Positive  # of the load-dependent sag [s]
    idle_power: NotNegative  # P_0, electronics [W]
    efficiency: Positive  # motor and speed controller [-]
    reference_voltage: Positive  # u_ref: voltage at which the thrust map was measured [V]


@dataclass(frozen=True)
class ThrustParams(BoundedFields):
    """Thrust and torque of rotor i from its speed and the battery voltage.

    ``f_i = gain_i (k_f Omega_i^2 + k_1 Omega_i) (1 + voltage_coefficient (u - u_ref))``,
    ``tau_i = torque_ratio torque_gain f_i``. The controller uses neither gain.
    """

    k_f: Positive  # thrust coefficient [N s^2/rad^2]
    k_1: float  # linear term [N s/rad]
    voltage_coefficient: float  # [1/V]
    torque_ratio: NotNegative  # kappa [m]
    # thrust of each rotor relative to the controller's map [-]
    gain: tuple[Positive, Positive, Positive, Positive] = (1.0, 1.0, 1.0, 1.0)
    torque_gain: Positive = 1.0  # drag torque relative to the controller's map [-]


@dataclass(frozen=True)
class AeroParams(BoundedFields):
    """Aerodynamics of the vehicle as a function of the centre of mass's air velocity v_b and the
    rate w.

    - rotor drag: ``dF = -(drag_x v_x, drag_y v_y, drag_z v_z)``
    - body drag: ``dF += -parasitic |v| v``
    - inflow on rotor i, with its hub velocity ``v_i = v_b + w x r_i``:
      ``df_i = f_i (-inflow v_iz + translational_lift (v_ix^2 + v_iy^2))`` adds to the thrust, at
      the rotor's arm, and ``dtau_i = kappa f_i (-torque_inflow v_iz)`` to the rotor's drag torque
    - blade flapping: ``dtau = flapping T (e_z x v_b)`` with T the sum of f_i.

    ``none``: all of it zero (the ablation).
    """

    kind: Literal["rotor_drag", "none"]
    drag_x: Drag  # [kg/s]
    drag_y: Drag  # [kg/s]
    drag_z: Drag  # [kg/s]
    parasitic: Drag  # 1/2 rho C_d A [kg/m]
    inflow: AirCoefficient  # [s/m]
    torque_inflow: AirCoefficient  # [s/m]
    translational_lift: AirCoefficient  # [s^2/m^2]
    flapping: AirCoefficient  # [s]


@dataclass(frozen=True)
class VehicleParams(BoundedFields):
    """A quadrotor: the seven blocks of Table I of the paper and the rigid body.

    The composer adds the blocks' forces and torques: ``F_b = (0, 0, sum f_i) + dF``,
    ``tau_b = sum_i r_i x (0, 0, f_i + df_i) + e_z sum_i s_i (tau_i + dtau_i + J_r Omega_i') - w x
    e_z h + dtau`` with the rotors' momentum ``h = -J_r sum_i s_i Omega_i`` (the gyroscopic torque
    does no work). A rotor that turns clockwise from above (s_i = +1) has angular momentum along -z
    and pushes the body towards +z.

    Positions of rotors and mount are relative to the frame's origin, which is nominally the centre
    of mass. If ``body.com`` is not zero, forces act with their arms about the true centre of mass,
    but the controller's mixer uses the arms about the origin."""

    body: BodyParams
    rotors: RotorParams
    queue: QueueParams
    controller: ControllerParams
    motor: MotorParams
    battery: BatteryParams
    thrust: ThrustParams
    aero: AeroParams
    # sphere about the centre of mass that the payload must not enter [m]
    collision_radius: NotNegative

    def __post_init__(self) -> None:
        """Raise ValueError for a vehicle that is physically impossible."""
        mass = self.body.mass
        super().__post_init__()
        c = self.controller
        rotors = self.rotors
        if self.motor.kind == "asymmetric" and not self.motor.time_constant_down:
            raise ValueError("motor.time_constant_down is 0.0; expected above 0")
        if 4.0 * c.max_thrust <= mass * GRAVITY:
            raise ValueError(
                f"controller.max_thrust is {c.max_thrust:g} N a motor; expected more than a quarter"
                f" of the vehicle's weight, {mass * GRAVITY / 4.0:.3g} N"
            )
        reach = max(map(math.hypot, rotors.x, rotors.y)) + rotors.radius
        for inertia in self.body.inertia:
            gyration = math.sqrt(inertia / mass)
            if not LEAST_GYRATION * reach <= gyration <= reach:
                raise ValueError(
                    f"body.inertia {inertia:g} kg m^2 puts {mass:g} kg {gyration:.3g} m"
                    f" from its middle; expected {LEAST_GYRATION * reach:.3g} m to"
                    f" {reach:.3g} m, where the rotors end"
                )
        if not c.min_thrust < c.max_thrust:
            raise ValueError(
                f"vehicle.controller.min_thrust is {c.min_thrust} N; expected less than max_thrust"
                f" {c.max_thrust} N"
            )
        if not (any(rotors.x) and any(rotors.y)) or abs(sum(rotors.spin)) > 0:
            raise ValueError(
                f"rotors at x={rotors.x}, y={rotors.y} with spin {rotors.spin}; expected four"
                " rotors spread along x and y, two turning each way"
            )


@dataclass(frozen=True)
class RopeParams(BoundedFields):
    """Rope of rigid slender segments on universal joints, and the payload rigidly on the last one.

    A segment has length ``length / segments`` and mass ``rope_mass / segments``. Its centre of mass
    is in the middle, its transverse inertia about it is ``m l^2 / 12`` and its axial inertia 0. The
    payload's centre is on the axis of the last segment, ``payload_offset`` beyond its end. Every
    joint, including the mount, has the viscous torque ``-joint_damping (w_i - w_(i-1))``; the mount
    has ``mount_damping`` in addition.

    The drag of the payload at the air velocity v_p is ``-payload_drag |v_p| v_p``. While it hangs,
    the rotors' downwash pushes it with the share ``downwash`` of their force, in the opposite
    direction, and ``-swing_damping`` times its velocity across the rope's last segment damps its
    swing. In free flight, a spinning or seamed ball has the additional force ``|v_p| (payload_side
    e_z x v_p + payload_lift v_p x e_a)`` with ``e_a`` the horizontal direction across its path,
    ``e_z x v_p`` normalised.

    An elastic rope stretches uniformly by ``compliance`` times its pull T at the mount: ``l = l_0
    (1 + compliance T / length)``. This is quasi-static: the swing is slow compared with the bounce
    of the payload on the rope (20 Hz at 1 mm/N), whose dynamics are neglected."""

    segments: int  # L, 1 to 64
    length: Length  # of the rope, without the payload [m]
    rope_mass: Mass  # [kg]
    payload_mass: Mass  # [kg]
    payload_inertia: NotNegative  # transverse, about the payload's centre [kg m^2]
    payload_offset: NotNegative  # [m]
    payload_radius: NotNegative  # of the ball, for drawing, keypoints and collisions [m]
    joint_damping: NotNegative  # [N m s]
    mount: Vector  # rope attachment in the body frame [m]
    # 1/2 rho C_d A of the payload, on the rope and in flight [kg/m]
    payload_drag: NotNegative = 0.0
    mount_damping: NotNegative = 0.0  # of the joint at the mount, plus joint_damping [N m s]
    swing_damping: NotNegative = 0.0  # [N s/m]
    downwash: NotNegative = 0.0  # [-]
    payload_side: float = 0.0  # 1/2 rho C_L A across the path, in flight [kg/m]
    payload_lift: float = 0.0  # 1/2 rho C_L A upwards in the path's vertical plane [kg/m]
    compliance: NotNegative = 0.0  # elongation over pull [m/N]
    # sides of a homogeneous box that swings about its upper face [m]; 0: a ball, rigid on the rope
    payload_sides: NotNegativeVector = (0.0, 0.0, 0.0)
    # distance along body x of two massless cables that replace the rope of a box [m]; 0: a rope
    cables_apart: NotNegative = 0.0
    gripper_mass: NotNegative = 0.0  # of the gripper at the rope's lower end [kg]

    def __post_init__(self) -> None:
        super().__post_init__()
        if not 1 <= self.segments <= 64:
            raise ValueError(f"rope of {self.segments} segments; expected 1 to 64")
        most = self.payload_mass * self.length**2
        if self.payload_inertia > most:
            raise ValueError(
                f"rope.payload_inertia is {self.payload_inertia:g} kg m^2; expected at most"
                f" payload_mass times length squared, {most:.3g} kg m^2"
            )
        box = any(self.payload_sides)
        if box and abs(self.payload_sides[2] - 2.0 * self.payload_offset) > 1e-9:
            raise ValueError(
                f"rope.payload_sides {self.payload_sides} with payload_offset"
                f" {self.payload_offset}; expected half the height of the box"
            )
        if self.cables_apart and not (box and self.segments == 1 and not self.gripper_mass):
            raise ValueError(
                f"rope.cables_apart {self.cables_apart} m; expected a box (payload_sides),"
                " segments = 1 and no gripper"
            )

    @property
    def segment_length(self) -> float:
        """Length of each segment [m]."""
        return self.length / self.segments

    @property
    def segment_mass(self) -> float:
        """Mass of each segment [kg]."""
        return self.rope_mass / self.segments

    def rod(self, loaded: bool) -> Vector:
        """Return a segment's mass [kg], the distance of its centre of mass from its upper end [m]
        and its transverse inertia about it [kg m^2]; a ``loaded`` segment includes the payload.
        """
        mass = self.segment_mass
        length = self.segment_length
        inertia = mass * length**2 / 12.0
        if not loaded:
            return mass, length / 2, inertia
        ball = self.payload_mass
        reach = length + self.payload_offset
        centre = (mass * length / 2 + ball * reach) / (mass + ball)
        inertia += self.payload_inertia
        inertia += mass * (centre - length / 2) ** 2 + ball * (reach - centre) ** 2
        return mass + ball, centre, inertia

    @property
    def hanging_mass(self) -> float:
        """Mass of rope, gripper and payload [kg]; two cables are massless."""
        rope = 0.0 if self.cables_apart else self.rope_mass
        return rope + self.gripper_mass + self.payload_mass

    def require_chain(self, owner: str) -> None:
        """Raise ValueError if anything but a chain with a ball hangs on the vehicle."""
        for name in ("payload_sides", "cables_apart", "gripper_mass"):
            value = getattr(self, name)
            if value not in (0.0, (0.0, 0.0, 0.0)):
                raise ValueError(
                    f"rope.{name} is {value}; {owner} holds a rope with a ball; expected"
                    " sim.solver 'mujoco_warp'"
                )


@dataclass(frozen=True)
class AirParams(BoundedFields):
    """Wind and ground effect.

    In every aerodynamic force, ``v_air = v - wind_w`` replaces v.

    Near the ground every rotor's thrust ``f_i`` is multiplied by ``1 + ground_effect (1 / (1 - (R /
    4 z)^2) - 1)`` with R the propeller's radius and z the height of the vehicle's centre of mass,
    at least R / 2 (Cheeseman and Bennett 1955 for ``ground_effect`` 1)."""

    wind_w: Vector = (0.0, 0.0, 0.0)  # constant wind, world frame [m/s]
    ground_effect: float = 0.0  # [-]


@dataclass(frozen=True)
class ReleaseParams(BoundedFields):
    """Release mechanism and the payload's free flight.

    The latch trips when the release command exceeds ``threshold``, and stays tripped. The payload
    separates after ``lag``; with ``lag_tension``, after ``lag + lag_tension (pull - m_p g)``, at
    least 0, where pull is the rope's pull at the latch. With the payload's position p and velocity
    v at separation, ``t_hit = (v_z + sqrt(v_z^2 + 2 g (p_z - landing_height))) / g``; with drag the
    flight is integrated by RK4.

    A rope that separates together with the payload exchanges momentum with it. The payload's mean
    velocity becomes ``v + rope_tail (v_c - v)``, v_c the velocity of the common centre of mass. The
    replay simulates the loose rope instead."""

    threshold: float  # [-]
    lag: Lag  # [s]
    landing_height: float  # z of the payload's centre at impact [m]
    clearance_samples: int  # K points of the flight at which the distance to the vehicle is tested
    clearance_margin: NotNegative  # d_m [m]
    # additional lag over the rope's pull at the latch in excess of the payload's weight [s/N]
    lag_tension: float = 0.0
    # change of the payload's velocity by the mechanism, world frame [m/s]
    kick_w: Vector = (0.0, 0.0, 0.0)
    kick_along: float = 0.0  # along the rope's last segment, away from the vehicle [m/s]
    rope_tail: Share = 0.0  # share of the rope that separates with the payload [-]

    def __post_init__(self) -> None:
        super().__post_init__()
        if self.clearance_samples < 2:
            raise ValueError(
                f"release.clearance_samples is {self.clearance_samples}; expected 2 or more"
            )


@dataclass(frozen=True)
class SimParams(BoundedFields):
    """Numerics of the batched simulator."""

    control_period: Duration  # of the policy [s]
    substep: Duration  # largest integration step [s]
    gamma: Positive  # of the ROS2 W-method [-]
    # if a segment rotates more in a substep, the step falls back to the first stage [rad]
    max_turn: Positive
    precision: Literal["float32", "float64"] = "float32"
    # solver of the bodies: the fused kernel, or one of sim.solvers.SOLVERS
    solver: Literal["chain", "exchanged_chain", "physx", "mujoco_warp"] = "chain"


MOST_FACTORS = 2  # largest number of factors of a law


@dataclass(frozen=True)
class LawParams(BoundedFields):
    """A force or torque in addition to those of the blocks: the product of a coefficient, scalars
    and a vector that :mod:`sim.kernels.laws` defines by name.

    It acts on the vehicle (force in the world frame, torque in the body frame), on the payload
    (hanging and in free flight), or in the rope's joint at the mount (torque on the vehicle in the
    body frame, and the opposite one on the rope)."""

    block: Literal["vehicle force", "vehicle torque", "payload force", "rope joint"]
    factors: tuple[str, ...]  # up to two scalars
    vector: str
    coefficient: float  # in the unit that makes the product N or N m

    def __post_init__(self) -> None:
        super().__post_init__()
        measured = LAW_FACTORS["measured"]
        vectors = [
            *LAW_FACTORS["vectors"].get(self.block, ()),
            *measured["vectors"].get(self.block, ()),
        ]
        scalars = [*LAW_FACTORS["scalars"], *measured["scalars"]]
        if len(self.factors) > MOST_FACTORS:
            raise ValueError(
                f"law on {self.block}: {len(self.factors)} factors; expected at most {MOST_FACTORS}"
            )
        for name, options in [(self.vector, vectors), *((f, scalars) for f in self.factors)]:
            if name not in options:
                similar = [
                    f"did you mean '{like}'? " for like in get_close_matches(name, options, 1)
                ]
                kind = "vector" if options is vectors else "factor"
                raise ValueError(
                    f"law on {self.block}: no {kind} '{name}'; {''.join(similar)}Known:"
                    f" {', '.join(options)}"
                )


LOWEST = 0.05  # height below which a law's 1/z is constant [m]
# rate of the rope relative to the vehicle below which a law's dry friction decreases to 0 [1/s]
SLOWEST = 0.1


@dataclass(frozen=True)
class PlantParams:
    """All parameters of a simulated plant."""

    vehicle: VehicleParams
    rope: RopeParams
    release: ReleaseParams
    sim: SimParams
    air: AirParams = AirParams()
    laws: tuple[LawParams, ...] = ()

    @property
    def total_mass(self) -> float:
        """Mass of vehicle, rope, gripper and payload [kg]."""
        return self.vehicle.body.mass + self.rope.hanging_mass


@dataclass(frozen=True)
class SensingParams(BoundedFields):
    """Errors of motion capture, gyro and camera in a log. All zero: ideal sensors.

    A sample with the stamp t measures the state at ``t - delay - clock_rate (t - start of the
    flight)``, with the delay of its channel. With the rotations F of ``frame_tilt`` and M of
    ``marker_rotation`` and the attitude R:

    - vehicle: ``p = (1 + scale) F (p_origin + R marker_offset)``, ``R_measured = F R M``; p_origin
      is the origin of the frame of the vehicle's parameters, not the centre of mass
    - payload: ``p = (1 + scale) F (p_payload + payload_offset)``
    - gyro: ``w = w_b + gyro_bias``
    - camera: a keypoint with the stamp t shows the scene at ``t - camera_delay + camera_line_time *
      row``
    """

    vehicle_delay: float = 0.0  # of the vehicle's stamps [s]
    payload_delay: float = 0.0  # of the payload's stamps [s]
    gyro_delay: float = 0.0  # [s]
    clock_rate: float = 0.0  # rate error of the sensors' clock relative to the commands' [-]
    scale: float = 0.0  # relative error of measured lengths [-]
    # rotation vector from the world to the measured frame [rad]
    frame_tilt: Vector = (0.0, 0.0, 0.0)
    marker_rotation: Vector = (0.0, 0.0, 0.0)  # [rad]
    marker_offset: Vector = (0.0, 0.0, 0.0)  # body frame [m]
    payload_offset: Vector = (0.0, 0.0, 0.0)  # world frame [m]
    gyro_bias: Vector = (0.0, 0.0, 0.0)  # [rad/s]
    camera_delay: float = 0.0  # of the keypoints' stamps [s]
    camera_line_time: float = 0.0  # between two rows of the image [s]


@dataclass(frozen=True)
class RandomizationParams(BoundedFields):
    """Uniform distributions of episodes' initial states (the paper, Sec. III-C, "Domain
    randomization").

    The vehicle starts at ``(0, 0, spawn_height)`` plus offsets; the cable hangs straight from the
    mount in the direction ``Rz(yaw) Rx(roll) (-z)`` of the body frame, with the two angles' rates
    added to the body's."""

    spawn_height: float  # of the vehicle's centre of mass [m]
    position: NotNegativeVector  # +- [m]
    velocity: NotNegativeVector  # +- [m/s]
    attitude_deg: NotNegativeVector  # +- roll, pitch, yaw [deg]
    rate_deg: NotNegativeVector  # +- body rates [deg/s]
    mass: NotNegative  # +- fraction of the vehicle's mass
    cable_angle_deg: NotNegative  # +- roll of the cable [deg]
    cable_rate_deg: NotNegative  # +- rates of its roll and yaw [deg/s]
    tether_variants: int  # number of cable lengths; each environment keeps its length
    tether_spread: NotNegative  # the lengths span +- this fraction
    battery_used: NotNegative  # fraction of charge used is drawn from 0 to this
    # goals are uniform in a disk of this radius on the ground below the spawn point [m]
    goal_radius: float
    # number of payload masses and of drags, in every combination with the cable lengths
    payload_variants: int = 1
    payload_spread: NotNegative = 0.0  # the masses span +- this fraction
    drag_spread: NotNegative = 0.0  # the payload's drags span +- this fraction
    cable_yaw_deg: NotNegative = 15.0  # +- yaw of the cable [deg]
