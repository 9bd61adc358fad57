"""Complete reference plant in float64: vehicle, rope, payload, release and free flight, with
optional effects of real vehicles.

Classical RK4 integrates bodies, rope and blocks together; MuJoCo computes the accelerations of each
stage. Steps end exactly at changes of the command, at the separation and at the times of
motion-capture samples."""

from dataclasses import MISSING, fields, replace

import numpy as np
from numpy import ndarray
from numpy.linalg import norm

from sim.params import GRAVITY, PlantParams
from sim.reference import vehicle_blocks
from sim.reference.quadrotor import (
    BLOCKS,
    BODY,
    MOTORS,
    POS,
    QUAT,
    RATE,
    VEL,
    VOLTAGE,
    VehicleErrors,
    initial_blocks,
    rigid_body_rates,
    vehicle_rates,
)
from sim.reference.reference_extras import ReferenceExtras
from sim.reference.rope import RopeDynamics
from sim.reference.rotation_arrays import cross, quat_dot, rotate, rotate_back, rotation_from_quat
from sim.reference.snapshot import PayloadLandings, Snapshot
from sim.reference.stepping import crossing, halving_rk4, segments_of_period

BLOCK_STATES = slice(BODY, BODY + BLOCKS)  # columns of the blocks
FREE = slice(BODY + BLOCKS, BODY + BLOCKS + 6)  # columns of a loose rope's upper end
LARGEST_DECAY = 2.2
"""Largest product of decay rate and step [-]; RK4 is stable up to 2.78 on the real axis."""


KNOWN_EXTENSIONS = {
    "body.com",
    "thrust.gain",
    "thrust.torque_gain",
    "air.wind_w",
    "air.ground_effect",
    "rope.payload_drag",
    "rope.mount_damping",
    "rope.swing_damping",
    "rope.downwash",
    "release.lag_tension",
    "release.kick_w",
    "release.kick_along",
}
"""Optional parameters that the plant supports. The payload's drag is also one of its extras."""


def _refuse_unknown(params: PlantParams) -> None:
    """Raise ValueError if the plant does not support all parameters."""
    vehicle = params.vehicle
    parts = {
        "body": vehicle.body,
        "thrust": vehicle.thrust,
        "rope": params.rope,
        "release": params.release,
        "air": params.air,
    }
    unknown = [
        f"{name}.{f.name}"
        for name, part in parts.items()
        for f in fields(part)
        if f.default is not MISSING
        and f"{name}.{f.name}" not in KNOWN_EXTENSIONS
        and getattr(part, f.name) != f.default
    ]
    unknown += ["laws"] if params.laws else []
    if unknown:
        raise ValueError(
            f"the reference plant does not know {', '.join(unknown)}; expected plants without"
        )


class ReferencePlant:
    """A batch of vehicles with ropes.

    Raises ValueError: a step that is not positive, or a parameter that is not supported.

    Args:
        params: vehicle, rope, release; of ``params.sim`` only the control period is used.
        extras: effects that the training simulator lacks.
        seed: of all random draws.
        count: number of environments E.
        step: largest integration step [s].
    """

    def __init__(
        self,
        params: PlantParams,
        extras: ReferenceExtras = ReferenceExtras(),
        seed: int = 0,
        count: int = 1,
        step: float = 5e-4,
    ):
        if not step > 0.0:
            raise ValueError(f"plant: step is {step} s, expected more than 0")
        _refuse_unknown(params)
        self.params = params
        self.extras = extras
        self.count = count
        self.step_size = step
        self._rng = np.random.default_rng(seed)
        self._ropes = None
        zero = np.zeros((count, 3))
        level = np.tile([0.0, 0.0, 0.0, 1.0], (count, 1))
        self.reset(zero + [0.0, 0.0, 1.5], level, zero, zero)

    def reset(
        self,
        pos_w: ndarray,
        quat_wb: ndarray,
        vel_w: ndarray,
        rate_b: ndarray,
        cable_dir_w: ndarray | None = None,
        cable_vel_w: ndarray | None = None,
    ) -> None:
        """Draw new vehicles and ropes and set their state, with rotors, battery and command queue
        at hover.

        Raises ValueError: an array of another shape.

        Args:
            pos_w: of the frame's origin [m], shape (E, 3).
            quat_wb: xyzw, shape (E, 4).
            vel_w: of the frame's origin [m/s], shape (E, 3).
            rate_b: [rad/s], shape (E, 3).
            cable_dir_w: unit directions of the segments from the mount outwards, shape (E, L, 3);
                None for hanging.
            cable_vel_w: their time derivatives [1/s], shape (E, L, 3); None for zero.
        """
        count = self.count
        hanging = np.tile([0.0, 0.0, -1.0], (count, self.params.rope.segments, 1))
        zero = np.zeros_like(hanging)
        inputs = {
            "pos_w": (pos_w, (count, 3)),
            "quat_wb": (quat_wb, (count, 4)),
            "vel_w": (vel_w, (count, 3)),
            "rate_b": (rate_b, (count, 3)),
            "cable_dir_w": (hanging if cable_dir_w is None else cable_dir_w, hanging.shape),
            "cable_vel_w": (zero if cable_vel_w is None else cable_vel_w, hanging.shape),
        }
        values = {name: _array(name, value, shape) for name, (value, shape) in inputs.items()}
        self._draw()
        rotation = rotation_from_quat(values["quat_wb"])
        offset = self._errors.com_offset
        pos = values["pos_w"] + rotate(rotation, offset)
        vel = values["vel_w"] + rotate(rotation, cross(values["rate_b"], offset))
        weight = (self.params.vehicle.body.mass + self._rope_mass) * GRAVITY
        block = initial_blocks(self.params.vehicle, values["rate_b"], weight, self._used)
        n = values["cable_dir_w"]
        n = n / norm(n, axis=-1, keepdims=True)
        n_dot = values["cable_vel_w"]
        n_dot = n_dot - np.sum(n_dot * n, -1, keepdims=True) * n
        body = pos, values["quat_wb"], vel, values["rate_b"], block, np.zeros((count, 6))
        ropes = n.reshape(count, -1), n_dot.reshape(count, -1), np.zeros((count, 2))
        self._state = np.hstack((*body, *ropes))
        if self._ropes.stretch is not None:
            self._state[:, -2] = self._payload_mass * GRAVITY / self.extras.stretch_stiffness
        self._begin(weight)

    def _begin(self, weight: ndarray) -> None:
        """Reset the clock, the release and the queue, which is filled with hover at ``weight`` [N],
        shape (E,).
        """
        count = self.count
        hover = np.zeros((count, 4))
        hover[:, 0] = weight
        self._queue_times = [np.full(count, -np.inf)]
        self._queue_commands = [hover]
        self.time = 0.0
        self._attached = np.ones(count, bool)
        self._latched = np.zeros(count, bool)
        self._landed = np.zeros(count, bool)
        self._separation = np.full(count, np.nan)
        self._landing_time = np.full(count, np.nan)
        self._landing_point = np.full((count, 3), np.nan)
        self._samples = [(-np.inf, self.state)]

    def _draw(self) -> None:
        """Draw the errors of this episode and build the ropes."""
        extras = self.extras
        rope = self.params.rope
        vehicle = self.params.vehicle
        count = self.count
        normal = self._rng.standard_normal
        gain = 1.0 + extras.thrust_gain_error + extras.thrust_gain_sigma * normal((count, 1))
        gain = gain + extras.motor_gain_sigma * normal((count, 4))
        com = np.add(vehicle.body.com, extras.com_offset)
        com = com + np.array(extras.com_offset_sigma) * normal((count, 3))
        self._errors = VehicleErrors(gain, com)
        self._payload_mass = rope.payload_mass * (1.0 + extras.payload_mass_sigma * normal(count))
        length = rope.length * (1.0 + extras.rope_length_sigma * normal(count))
        self._used = self._rng.uniform(0.0, 1.0, count) * extras.battery_start_used
        self._rope_mass = self._payload_mass + rope.rope_mass
        self._wind = self._mean_wind + np.array(extras.wind_sigma_w) * normal((count, 3))
        self._next_wind = self._wind
        # Compiling a model takes milliseconds. Without these draws the last episode's ropes are
        # reused.
        if self._ropes is None or (
            extras.payload_mass_sigma or extras.rope_length_sigma or any(extras.com_offset_sigma)
        ):
            self._build_ropes(length, com)

    def _build_ropes(self, length: ndarray, com: ndarray) -> None:
        """Build ropes of the given lengths [m], shape (E,), on vehicles with the given centres of
        mass [m], shape (E, 3), and choose a stable step.
        """
        extras = self.extras
        rope = self.params.rope
        vehicle = self.params.vehicle
        damping = rope.joint_damping + extras.extra_joint_damping
        ropes = [
            replace(
                rope,
                mount=tuple(np.array(rope.mount) - com[i]),
                length=length[i],
                payload_mass=mass,
                joint_damping=damping,
                payload_inertia=rope.payload_inertia * mass / rope.payload_mass,
            )
            for i, mass in enumerate(self._payload_mass)
        ]
        if extras.stretch_stiffness > 0.0:
            stretch = (extras.stretch_stiffness, extras.stretch_damping)
        else:
            stretch = None
        self._ropes = RopeDynamics(vehicle.body, ropes, stretch, rope.mount_damping)
        # The bending modes of light segments decay at rates up to 48 d / (m l^2), for which RK4 may
        # be unstable.
        shortest = float(np.min(length) / rope.segments)
        inertia = rope.segment_mass * shortest**2
        fastest = 48.0 * (damping + rope.mount_damping) / inertia
        self._step = self.step_size
        if fastest > 0.0:
            self._step = min(self.step_size, LARGEST_DECAY / fastest)

    @property
    def _mean_wind(self) -> ndarray:
        return np.array(self.params.air.wind_w) + np.array(self.extras.wind_mean_w)

    def _rope_of(self, state: ndarray) -> tuple[ndarray, ndarray, ndarray, ndarray]:
        """Return directions, their derivatives, elongation and its rate."""
        n, n_dot = (state[:, columns].reshape(len(state), -1, 3) for columns in self._rope_columns)
        return n, n_dot, state[:, -2], state[:, -1]

    @property
    def _rope_columns(self) -> tuple[slice, slice]:
        middle = FREE.stop + 3 * self._ropes.segments
        return slice(FREE.stop, middle), slice(middle, 2 * middle - FREE.stop)

    def _upper_end(
        self, state: ndarray, rotation: ndarray | None = None
    ) -> tuple[ndarray, ndarray]:
        """Return position and velocity of the rope's upper end, which is the mount while attached;
        ``rotation``: of the vehicles, if already computed.
        """
        rotation = rotation_from_quat(state[:, QUAT]) if rotation is None else rotation
        arm = rotate(rotation, self._ropes.mount)
        arm_dot = rotate(rotation, cross(state[:, RATE], self._ropes.mount))
        on = self._attached[:, None]
        free = state[:, FREE]
        pos = np.where(on, state[:, POS] + arm, free[:, :3])
        return pos, np.where(on, state[:, VEL] + arm_dot, free[:, 3:])

    def _points(self, state: ndarray) -> tuple[ndarray, ndarray, ndarray]:
        """Return the joints of the ropes, and position and velocity of the payloads."""
        return self._ropes.points(*self._upper_end(state), self._rope_of(state))

    def _rates(self, state: ndarray, command: ndarray, wind_w: ndarray, moving: ndarray) -> ndarray:
        """Return the time derivative of the whole state. Ropes of landed payloads are at rest.
        Where ``moving`` is false, ropes are not accelerated and do not act on vehicles.
        """
        vehicle = self.params.vehicle
        rates = np.zeros_like(state)
        rotation = rotation_from_quat(state[:, QUAT])
        body = state[:, :BODY]
        rate_b = state[:, RATE]
        air_b = rotate_back(rotation, body[:, VEL] - wind_w)
        near_ground = vehicle_blocks.compute_ground_factor(
            self.params.air.ground_effect, vehicle.rotors.radius, state[:, 2]
        )
        force_b, torque_b, rates[:, BLOCK_STATES], thrust = vehicle_rates(
            vehicle,
            self._errors,
            state[:, BLOCK_STATES],
            command,
            air_b,
            rate_b,
            near_ground,
        )
        force_w = rotate(rotation, force_b)
        rates[:, :BODY] = rigid_body_rates(vehicle, body, force_w, torque_b)
        rope = self._rope_of(state)
        root = self._upper_end(state, rotation)
        lift_w = rotation[:, :, 2] * thrust.sum(axis=1, keepdims=True)
        payload_vel_w = self._ropes.payload_velocity(root[1], rope)
        drag_w = vehicle_blocks.payload_force(
            self.params.rope,
            self.extras.payload_drag,
            payload_vel_w,
            wind_w,
            rope[0][:, -1],
            lift_w,
            self._attached,
        )
        second, stretch_dot = self._rope_rates(
            rates, body, rotation, (force_w, torque_b), rope, root, drag_w, moving
        )
        airborne = (~self._landed)[:, None]
        direction, velocity = self._rope_columns
        rates[:, direction] = (rope[1] * airborne[..., None]).reshape(self.count, -1)
        rates[:, velocity] = second.reshape(self.count, -1)
        rates[:, -2] = rope[3] * airborne[:, 0]
        rates[:, -1] = stretch_dot
        return rates

    def _rope_rates(
        self,
        rates: ndarray,
        body: ndarray,
        rotation: ndarray,
        wrench: tuple[ndarray, ndarray],
        rope: tuple,
        root: tuple,
        drag_w: ndarray,
        moving: ndarray,
    ) -> tuple[ndarray, ndarray]:
        """Write the accelerations of vehicles with ropes and of loose ropes into ``rates``; return
        the second derivatives of the ropes' directions and elongations.
        """
        second = np.zeros_like(rope[0])
        stretch_dot = np.zeros(self.count)
        ids = np.flatnonzero(self._attached & moving)
        if len(ids):
            picked = tuple(part[ids] for part in rope)
            pulled = (wrench[0][ids], wrench[1][ids])
            rates[ids, VEL.start : RATE.stop], second[ids], stretch_dot[ids] = (
                self._ropes.accelerate_attached(
                    ids, body[ids], rotation[ids], pulled, picked, drag_w[ids]
                )
            )
        flying = np.flatnonzero(~self._attached & ~self._landed & moving)
        if len(flying):
            picked = tuple(part[flying] for part in rope)
            acceleration, second[flying], stretch_dot[flying] = self._ropes.accelerate_free(
                flying, (root[0][flying], root[1][flying]), picked, drag_w[flying]
            )
            rates[flying, FREE] = np.hstack((root[1][flying], acceleration))
        return second, stretch_dot

    def _pull(self) -> ndarray:
        """Return the rope's force on the mount along its first segment [N], shape (E,), computed
        from the vehicles' accelerations with and without the rope.
        """
        times = np.array(self._queue_times)
        commands = np.array(self._queue_commands)
        clock = np.full(self.count, self.time)
        command = vehicle_blocks.command_queue(times, commands, clock)
        moving = np.ones(self.count, bool)
        with_rope = self._rates(self._state, command, self._wind, moving)[:, VEL]
        without = self._rates(self._state, command, self._wind, ~moving)[:, VEL]
        force_w = self.params.vehicle.body.mass * (with_rope - without)
        return np.sum(force_w * self._rope_of(self._state)[0][:, 0], axis=1)

    def step(self, command: ndarray, release: ndarray | bool = False) -> None:
        """Queue a command and advance by one control period.

        Args:
            command: collective thrust [N] and body rates [rad/s], shape (E, 4); acts after the
                delay of the queue.
            release: trip the latch now, shape (E,), bool; a latch stays tripped.
        """
        count = self.count
        params = self.params
        extras = self.extras
        rng = self._rng
        period = params.sim.control_period
        start = self.time
        end = self.time + period
        jitter = extras.delay_jitter * rng.uniform(-1.0, 1.0, count)
        acts = start + np.maximum(params.vehicle.queue.delay + jitter, 0.0)
        self._queue_times.append(np.maximum(acts, self._queue_times[-1]))
        commands = np.broadcast_to(np.asarray(command, dtype=np.float64), (count, 4))
        self._queue_commands.append(commands.copy())
        lag = params.release.lag
        if params.release.lag_tension:
            lag = vehicle_blocks.release_lag(params.release, self._pull(), self._payload_mass)
        lag = lag + extras.release_lag_jitter * rng.uniform(-1.0, 1.0, count)
        tripped = np.broadcast_to(np.asarray(release, dtype=bool), (count,)) & ~self._latched
        self._separation = np.where(tripped, start + np.maximum(lag, 0.0), self._separation)
        self._latched = self._latched | tripped
        decay = np.exp(-period / extras.wind_time_constant)
        mean = self._mean_wind
        sigma = np.sqrt(1 - decay**2) * np.array(extras.wind_sigma_w)
        gust = sigma * rng.standard_normal((count, 3))
        self._next_wind = mean + decay * (self._wind - mean) + gust
        self._advance(end)
        self._wind = self._next_wind
        self.time = end
        self._prune(end)

    def _advance(self, end: float) -> None:
        """Integrate one period, and store the state that motion capture measures at its end."""
        sample = end - self.extras.mocap_latency % (end - self.time)
        self._integrate(self.time, sample, end)
        self._samples.append((sample, replace(self.state, time=sample)))
        self._integrate(sample, end, end)
        self._separate(np.full(self.count, end))

    def _integrate(self, start: float, stop: float, end: float) -> None:
        """Integrate a part of the period that lasts until ``end``, from event to event in each
        environment.
        """
        times = np.array(self._queue_times)
        commands = np.array(self._queue_commands)
        edges = []
        for e in range(self.count):
            events = (*times[1:, e], self._separation[e])
            edges.append([start, *(t for t in events if start < t < stop), stop])
        steps = segments_of_period(edges, self._step)
        clock = np.full(self.count, start)
        for column in steps.T:
            self._separate(clock)
            middle = clock + 0.5 * column
            command = vehicle_blocks.command_queue(times, commands, middle)
            share = ((middle - self.time) / (end - self.time))[:, None]
            wind_w = self._wind + share * (self._next_wind - self._wind)
            before = self._state
            self._state = halving_rk4(
                lambda x, h: self._rates(x, command, wind_w, h > 0.0),
                before,
                column,
                *self._rope_columns,
            )
            self._normalise()
            self._land(before, clock, column)
            clock = clock + column

    def _separate(self, clock: ndarray) -> None:
        """Detach the ropes whose separation is due; their upper ends keep the mount's velocity plus
        the release's kick.
        """
        due = self._attached & (self._separation <= clock + vehicle_blocks.TIME_TOLERANCE)
        if np.any(due):
            pos, vel = self._upper_end(self._state)
            direction_w = self._rope_of(self._state)[0][:, -1]
            vel = vel + vehicle_blocks.release_kick(self.params.release, direction_w)
            self._state[due, FREE] = np.hstack((pos, vel))[due]
            self._attached = self._attached & ~due

    def _normalise(self) -> None:
        self._state[:, QUAT] /= norm(self._state[:, QUAT], axis=1, keepdims=True)
        n, n_dot, _, _ = self._rope_of(self._state)
        n /= norm(n, axis=-1, keepdims=True)
        n_dot -= np.sum(n * n_dot, -1, keepdims=True) * n

    def _land(self, before: ndarray, clock: ndarray, step: ndarray) -> None:
        """Record the payloads that reach the landing height in this step."""
        flying = ~self._attached & ~self._landed & (step > 0.0)
        if not np.any(flying):
            return
        height = self.params.release.landing_height
        _, pos_0, vel_0 = self._points(before)
        _, pos_1, vel_1 = self._points(self._state)
        for e in np.flatnonzero(flying & (pos_1[:, 2] <= height)):
            share, point = crossing(pos_0[e], vel_0[e], pos_1[e], vel_1[e], step[e], height)
            self._landed[e] = True
            self._landing_time[e] = clock[e] + share * step[e]
            self._landing_point[e] = point

    def _prune(self, time: float) -> None:
        while len(self._queue_times) > 1 and np.all(self._queue_times[1] <= time):
            del self._queue_times[0], self._queue_commands[0]
        latest = time - self.extras.mocap_latency + vehicle_blocks.TIME_TOLERANCE
        while len(self._samples) > 1 and self._samples[1][0] <= latest:
            del self._samples[0]

    @property
    def state(self) -> Snapshot:
        """Current true state."""
        state = self._state
        rotation = rotation_from_quat(state[:, QUAT])
        blocks = state[:, BLOCK_STATES]
        offset = self._errors.com_offset
        points, ball, ball_vel = self._points(state)
        landed = self._landed[:, None]
        return Snapshot(
            time=self.time,
            pos_w=state[:, POS] - rotate(rotation, offset),
            quat_wb=state[:, QUAT].copy(),
            vel_w=state[:, VEL] - rotate(rotation, cross(state[:, RATE], offset)),
            rate_b=state[:, RATE].copy(),
            payload_pos_w=np.where(landed, self._landing_point, ball),
            payload_vel_w=np.where(landed, 0.0, ball_vel),
            cable_points_w=points,
            motor_speed=blocks[:, MOTORS].copy(),
            battery_voltage=blocks[:, VOLTAGE].copy(),
            attached=self._attached.copy(),
            latched=self._latched.copy(),
        )

    @property
    def landing(self) -> PayloadLandings:
        """Landing points and times of the payloads."""
        separated = np.where(self._attached, np.nan, self._separation)
        return PayloadLandings(
            self._landed.copy(), self._landing_point.copy(), self._landing_time.copy(), separated
        )

    @property
    def exposed(self) -> Snapshot:
        """True state at the time that :meth:`measure` refers to."""
        return self._samples[0][1]

    def measure(self) -> Snapshot:
        """Return the state as measured by motion capture and gyro: delayed by the latency, with new
        noise in each call.

        ``time`` is the time of the sample. ``cable_points_w`` and the flags are not measured: the
        points are exact, for drawing, and the flags are the vehicle's current ones."""
        extras = self.extras
        rng = self._rng
        time, sample = self._samples[0]
        rotation_noise = 0.5 * extras.mocap_angle_sigma * rng.standard_normal((self.count, 3))
        quat = sample.quat_wb + quat_dot(sample.quat_wb, 2.0 * rotation_noise)
        sigmas = {
            "pos_w": extras.mocap_position_sigma,
            "payload_pos_w": extras.mocap_position_sigma,
            "vel_w": extras.mocap_velocity_sigma,
            "payload_vel_w": extras.mocap_velocity_sigma,
            "rate_b": extras.gyro_sigma,
        }
        noisy = {
            name: getattr(sample, name) + sigma * rng.standard_normal((self.count, 3))
            for name, sigma in sigmas.items()
        }
        noisy["quat_wb"] = quat / norm(quat, axis=1, keepdims=True)
        return replace(
            sample,
            time=max(time, 0.0),
            attached=self._attached.copy(),
            latched=self._latched.copy(),
            **noisy,
        )


def _array(name: str, value: ndarray, shape: tuple[int, ...]) -> ndarray:
    array = np.array(value, dtype=np.float64)
    if array.shape != shape:
        raise ValueError(f"plant: {name} has shape {array.shape}, expected {shape}")
    return array
