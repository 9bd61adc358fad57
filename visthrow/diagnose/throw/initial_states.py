"""Initial states of replay windows: first guesses from smoothed measurements, and the directions
in which they are uncertain.
"""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy import ndarray
from numpy.polynomial.polynomial import polyfit, polyval
from scipy.spatial.transform import Rotation

from sim.effects.setting import Setting
from sim.kernels.replay.kernel import ATTACHED, LOOSE
from sim.kernels.replay.lanes import still
from sim.params import GRAVITY, PlantParams, SensingParams, VehicleParams
from visthrow.common.rotations import cross, normal_part
from visthrow.diagnose.throw.cutting import Cut
from visthrow.diagnose.throw.recorded_flight import ChannelSamples, RecordedFlight

# measurements from this long before a window's start to this long after it are smoothed [s]
SMOOTH_BEFORE = 0.06
SMOOTH_AFTER = 0.08
LEAST_SAMPLES = 6
MODES = 4  # highest mode of the rope's bending, in half waves
INTEGRAL = 1.0
"""Prior deviation of the rate error's integral [rad]. With a third of it, the estimate of a centre
of mass that is 1.4 mm off came out a quarter too small over 80 windows.
"""

BENT = (0.03, 0.5)
SHAKEN = (0.1, 1.5)
"""Prior deviation of a bend of the rope [rad] and of its rate [rad/s], for a rope that stayed taut
and for one that has just become taut.

Ropes simulated through the preceding windows reach a window with bends of some 0.005 rad, at most
0.03 rad. With a wider prior, a rope that is too long could bend to fit the measured distance; the
bend would then whip."""
HUNG = 0.1
"""Factor on the deviations of a taut rope where it hung still before: such ropes reach a window
with bends of 0.0005 rad.

With a wider prior, noise is fitted by bends of 0.02 rad. They whip, which biases the masses of rope
and payload.
"""

RIGID = (
    ("pos_w", 0.1, 1e-4),
    ("quat_wb", 0.1, 1e-4),
    ("vel_w", 1.0, 1e-3),
    ("rate_b", 3.0, 1e-3),
)
"""Fields of a body's state with the deviations of their vague priors and the steps of their
derivatives.
"""

ROPE = ("cable_dir_w", "cable_vel_w")

States = dict[str, ndarray]  # fields of ``STATE_FIELDS``, shape (S, ...)
MOVED = "moved"
"""Key for the displacement of each state from the mean of its prior along the directions, shape
(S, directions).
"""


@dataclass(frozen=True)
class Direction:
    """A direction of the state space in which an initial state is uncertain."""

    field: str
    axis: int
    sd: float  # vague prior, in the field's unit (attitude: angle [rad])
    step: float  # for the derivative
    part: str | int = ""  # of the rope: "all" segments, the "last", or the half waves of a bend
    calm: float | None = None  # prior where the rope was taut all the time, if it differs

    @property
    def place(self) -> tuple[str, int, str | int]:
        """Return an identifier of the direction that does not depend on its prior."""
        return self.field, self.axis, self.part

    @property
    def follows(self) -> bool:
        """Return whether the state is adjusted in this direction when the effects change. Bends of
        the rope are not: they would absorb a wrong length.
        """
        return not self.field.startswith("cable") or self.part == "all"

    def deviation(self, c: Cut) -> float:
        """Return the prior deviation in a window; 0 if the direction does not exist there. Only a
        rope that has just become taut has higher bends.
        """
        if self.field.startswith("cable"):
            low = self.part in ("all", "last", 1)
            present = c.payload == ATTACHED and (c.after_slack or low)
        else:
            present = c.payload == LOOSE or not self.field.startswith("payload")
        if self.calm is None or c.after_slack or not present:
            return self.sd * present
        return HUNG * self.calm if c.at_rest else self.calm


def deviations(directions: Sequence[Direction], cuts: Sequence[Cut]) -> ndarray:
    """Return the prior deviations of windows' initial states, shape (W, directions); 0 where a
    direction does not exist.
    """
    return np.array([[direction.deviation(c) for direction in directions] for c in cuts])


def directions(plant: PlantParams) -> tuple[Direction, ...]:
    """List the directions. Their priors are vague where an error of a sensor can shift the
    state.
    """
    controller = plant.vehicle.controller
    listed = [Direction(field, i, sd, step) for field, sd, step in RIGID for i in range(3)]
    if controller.kind != "geometric":
        for i, gain in enumerate(controller.i_gain):
            if gain > 0.0:
                listed.append(Direction("integral", i, INTEGRAL * gain, 1e-3 * gain))
    if plant.vehicle.motor.kind != "instant":
        hover = np.sqrt(plant.vehicle.body.mass * GRAVITY / 4.0 / plant.vehicle.thrust.k_f)
        listed += [Direction("motor_speed", i, 0.15 * hover, 1e-4 * hover) for i in range(4)]
    for part in ("all", *("last", *range(1, MODES + 1))[: plant.rope.segments - 1]):
        deviations = zip(SHAKEN, BENT) if part != "all" else [(0.1, None), (1.5, None)]
        for field, step, (sd, calm) in zip(ROPE, (1e-4, 1e-3), deviations):
            listed += [Direction(field, i, sd, step, part, calm) for i in range(2)]
    listed += [Direction("payload_pos_w", i, 0.1, 1e-4) for i in range(3)]
    return (*listed, *[Direction("payload_vel_w", i, 1.0, 1e-3) for i in range(3)])


def _tangents(n: ndarray) -> ndarray:
    """Return two unit vectors normal to each direction, shape (..., 2, 3)."""
    x_axis, y_axis, _ = np.eye(3)
    axis = np.where(np.abs(n[..., :1]) < 0.7, x_axis, y_axis)
    first = np.cross(n, axis)
    first /= np.linalg.norm(first, axis=-1, keepdims=True)
    return np.stack((first, np.cross(n, first)), axis=-2)


def move_along(states: States, directions: Sequence[Direction], sizes: ndarray) -> States:
    """Move states along all directions by ``sizes``, shape (S, directions). Directions of the rope
    must precede those of its rates.
    """
    out = {**states, MOVED: states[MOVED] + sizes}
    for field in dict.fromkeys(direction.field for direction in directions):
        members = [d for d, direction in enumerate(directions) if direction.field == field]
        axes = [directions[d].axis for d in members]
        size = sizes[:, members]
        value = states[field].copy()
        if field == "quat_wb":
            turn = np.zeros((len(value), 3))
            turn[:, axes] = size
            value = (Rotation.from_quat(value) * Rotation.from_rotvec(turn)).as_quat()
        elif field.startswith("cable"):
            n = out["cable_dir_w"]
            # the whole rope uses the tangent plane of its last segment
            frame = _tangents(n[:, -1])[:, axes]
            shapes = np.array([_shape(directions[d].part, n.shape[1]) for d in members])
            displacement = np.einsum("sd,dl,sdx->slx", size, shapes, frame)
            value = out[field] + normal_part(displacement, n)
            if field == "cable_dir_w":
                value /= np.linalg.norm(value, axis=-1, keepdims=True)
                out["cable_vel_w"] = normal_part(states["cable_vel_w"], value)
        else:
            value[:, axes] += size
        out[field] = value
    return out


def _shape(part: str | int, segments: int) -> ndarray:
    """Return the angle by which each segment turns, shape (L,)."""
    number = np.arange(segments)
    if part == "all":
        return np.ones(segments)
    if part == "last":
        return (number == segments - 1).astype(float)
    return np.cos(part * np.pi * (number + 0.5) / segments)


def rows_of(states: States, rows: ndarray) -> States:
    """Return some of the states."""
    return {name: value[rows] for name, value in states.items()}


def stack(parts: list[States]) -> States:
    """Concatenate states."""
    return {name: np.concatenate([p[name] for p in parts]) for name in parts[0]}


def smooth(
    samples: ChannelSamples, time: float, before: float = SMOOTH_BEFORE, after: float = SMOOTH_AFTER
) -> tuple[ndarray, ndarray] | None:
    """Fit a local polynomial to the samples about a time; return its value and derivative there,
    None if there are too few samples.
    """
    for reach in (1.0, 2.0, 4.0):
        chosen = samples.during(time - reach * before, time + reach * after)
        if len(chosen.time) >= LEAST_SAMPLES:
            since = chosen.time - time
            if chosen.values.shape[1] == 4:
                return _smooth_turn(since, chosen.values)
            degree = 2 if len(since) < 12 else 3
            fit = polyfit(since, chosen.values, degree)
            return fit[0], fit[1]
    return None


def _smooth_turn(time: ndarray, quats: ndarray) -> tuple[ndarray, ndarray]:
    """Return the attitude at time 0 (xyzw) and the body rate there [rad/s]."""
    middle = Rotation.from_quat(quats[np.abs(time).argmin()])
    turn = (middle.inv() * Rotation.from_quat(quats)).as_rotvec()
    fit = polyfit(time, turn, 2 if len(time) < 12 else 3)
    return (middle * Rotation.from_rotvec(fit[0])).as_quat(), fit[1]


def without_frame(x: SensingParams, vectors: ndarray) -> ndarray:
    """Transform measured points [m] or velocities [m/s], shape (..., 3), into the world's frame."""
    return Rotation.from_rotvec(x.frame_tilt).inv().apply(vectors) / (1.0 + x.scale)


def without_marker(x: SensingParams, measured: Rotation) -> Rotation:
    """Convert the measured attitude of the marker body into the vehicle's, in the world's frame."""
    frame = Rotation.from_rotvec(x.frame_tilt)
    return frame.inv() * measured * Rotation.from_rotvec(x.marker_rotation).inv()


def measured_state(
    flight: RecordedFlight, time: float, setting: Setting, payload: int, inner: States
) -> States:
    """Return the state at a time of a flight: measured fields from smoothed samples, all others
    from ``inner`` (one state).

    The setting's delays, frame and marker offsets are removed from the measurements.
    """
    out = {name: value.copy() for name, value in inner.items()}
    x = setting.sensing
    plant = setting.plant
    instant = time + x.vehicle_delay
    pos, vel = smooth(flight.vehicle, instant) or (flight.vehicle.values[0], np.zeros(3))
    quat, rate = smooth(flight.attitude, instant) or (flight.attitude.values[0], np.zeros(3))
    attitude = without_marker(x, Rotation.from_quat(quat))
    rate = Rotation.from_rotvec(x.marker_rotation).apply(rate)
    gyro = flight.gyro and smooth(flight.gyro, time + x.gyro_delay)
    if gyro:
        rate = gyro[0] - x.gyro_bias
    off = np.subtract(x.marker_offset, plant.vehicle.body.com)
    pos, vel = without_frame(x, np.array([pos, vel]))
    out["pos_w"][0] = pos - attitude.apply(off)
    out["quat_wb"][0] = attitude.as_quat()
    out["vel_w"][0] = vel - attitude.apply(cross(rate, off))
    out["rate_b"][0] = rate
    track = flight.payload and smooth(flight.payload, time + x.payload_delay)
    if track and payload in (ATTACHED, LOOSE):
        point, speed = without_frame(x, np.array(track))
        point = point - x.payload_offset
        out["payload_pos_w"][0] = point
        out["payload_vel_w"][0] = speed
        if payload == ATTACHED:
            _hang(out, plant, attitude, point, speed)
    return out


def _hang(
    state: States, plant: PlantParams, attitude: Rotation, point: ndarray, speed: ndarray
) -> None:
    """Turn the rope as a rigid shape so that it points from the mount to the payload, and give it
    the angular rate of that line.
    """
    arm = np.subtract(plant.rope.mount, plant.vehicle.body.com)
    mount = state["pos_w"][0] + attitude.apply(arm)
    mount_vel = state["vel_w"][0] + attitude.apply(cross(state["rate_b"][0], arm))
    reach = point - mount
    distance = max(np.linalg.norm(reach), 1e-3)
    n = state["cable_dir_w"][0]
    u = state["cable_vel_w"][0]
    link = np.full((len(n), 1), plant.rope.length / len(n))
    link[-1] += plant.rope.payload_offset
    chord = (link * n).sum(0)
    chord /= np.linalg.norm(chord)
    turn, _ = Rotation.align_vectors(reach, chord)
    n = turn.apply(n)
    u = turn.apply(u)
    lacking = speed - mount_vel - (link * u).sum(0)
    spin = cross(reach, lacking) / distance**2
    state["cable_dir_w"][0] = n
    state["cable_vel_w"][0] = u + np.cross(spin, n)


def hover_state(flight: RecordedFlight, plant: PlantParams) -> States:
    """Return a hover state at the flight's start, for the fields that the first window's samples do
    not measure.
    """
    v = plant.vehicle
    battery = v.battery
    rope = plant.rope
    L = rope.segments
    thrust = max(flight.command[0, 0], 0.05)
    power = _power(v, thrust)
    used = _charge(flight, v, power)
    volts = battery.reference_voltage
    if battery.kind == "sag":
        open_volts = polyval(used, battery.ocv)
        square = open_volts**2 - 4.0 * battery.resistance * power
        volts = 0.5 * (open_volts + np.sqrt(max(square, 0.0)))
    state = still(1, L)
    state["motor_speed"][:] = np.sqrt(thrust / 4.0 / v.thrust.k_f)
    state["setpoint"][:] = flight.command[0, 1:]
    state["charge_used"][:] = used
    state["voltage"][:] = volts
    segments_below = np.arange(L, 0, -1) - 0.5
    mass_below = rope.payload_mass + rope.rope_mass * segments_below / L
    state["stiffness"][:] = mass_below * GRAVITY * rope.length / L
    return state


def _power(v: VehicleParams, thrust: float) -> float:
    """Return the power drawn from the battery [W] at a steady collective thrust [N]."""
    speed = np.sqrt(thrust / 4.0 / v.thrust.k_f)
    return v.battery.idle_power + thrust * speed * v.thrust.torque_ratio / v.battery.efficiency


def _charge(flight: RecordedFlight, v: VehicleParams, power: float) -> float:
    """Return the fraction of the charge that is used at the start.

    It follows from the first logged voltage and the power [W] drawn then. Without a logged voltage,
    a controller that does not compensate voltage is assumed to start at the voltage of the hover in
    which its throttle was calibrated; otherwise a fifth is assumed."""
    cell = v.battery
    c = v.controller
    volts = flight.voltage
    if volts is None and c.kind == "motor_mixing":
        volts = c.calibration_voltage
        power = _power(v, 4.0 * c.mix_thrust)
    if volts is None or cell.kind != "sag":
        return 0.2 if cell.kind == "sag" else 0.0
    grid = np.linspace(0.0, 1.0, 201)
    open_volts = volts + cell.resistance * power / volts
    return np.interp(-open_volts, -polyval(grid, cell.ocv), grid)
