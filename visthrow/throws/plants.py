"""A common interface for the two plants, the training simulator and the reference plant, with NumPy
arrays.
"""

import math
from collections.abc import Sequence
from dataclasses import replace
from typing import Any, Protocol

import numpy as np
from numpy import ndarray
from numpy.linalg import norm

from sim.params import AirParams, RandomizationParams, RopeParams
from sim.reference.snapshot import PayloadLandings as PayloadLandings
from sim.reference.snapshot import Snapshot as Snapshot
from visthrow import config
from visthrow.common.errors import ConfigError, suggest
from visthrow.common.free_fall import GRAVITY, free_flight
from visthrow.common.rotations import cross, rotate, rotate_by_small_angles
from visthrow.task import Experiment, NoiseParams, plant_of
from visthrow.throws.loose_rope import LooseRope

PLANTS = {
    "hybrid": (
        "the training simulator",
        "the training simulator with all its noise and randomisation",
    ),
    "reference": (
        "the reference plant without extras",
        "the reference plant (MuJoCo) without extras: measurements late but exact, still air",
    ),
    "reference-realistic": (
        "the realistic reference plant",
        "the reference plant (MuJoCo) with pinned wind, drag, build errors and mocap noise",
    ),
}
"""Name -> its description in pictures, and in titles of tables."""


def check_plant(name: str) -> str:
    """Return the name if it is in :data:`PLANTS`, or raise ConfigError."""
    if name not in PLANTS:
        raise ConfigError(f"no plant '{name}'; {suggest(name, PLANTS)}")
    return name


# state arrays of vehicles and ropes
BODIES = ("pos_w", "quat_wb", "vel_w", "rate_b", "cable_dir_w", "cable_vel_w")
FALL_STEP = 0.02  # largest RK4 step in flight [s]; error for a tennis ball: 1e-8 m after 1 s


class Plant(Protocol):
    """A plant that can be flown."""

    name: str
    count: int
    period: float
    time: float

    def reset(self, pos_w: ndarray, cable_dir_w: ndarray | None = None) -> None:
        """Place the vehicles at positions [m], shape (E, 3), level and at rest, with rope
        directions (E, L, 3); default straight down.
        """

    def step(self, command: ndarray, release: ndarray | bool = False) -> None:
        """Advance one control period under commands [N, rad/s], shape (E, 4)."""

    @property
    def state(self) -> Snapshot:
        """Return the true state."""

    def measure(self) -> Snapshot:
        """Return the measurements for the pilot, with the plant's noise and latency."""

    @property
    def exposed(self) -> Snapshot:
        """Return the true state at the time of :meth:`measure`, as a camera that is triggered with
        motion capture sees it.
        """

    @property
    def sample(self) -> Snapshot:
        """Return the samples of motion capture and gyro in the last :meth:`measure`; ``time`` is
        the time at which they were taken.
        """

    @property
    def landing(self) -> PayloadLandings:
        """Return the landings so far."""


class HybridPlant:
    """The training simulator.

    After the release the ball's flight is computed by `fly_payloads` and the rope's by `LooseRope`.
    """

    name = "hybrid"

    def __init__(
        self,
        experiment: Experiment,
        count: int = 1,
        seed: int = 0,
        device: str = "cpu",
        noise: NoiseParams | None = None,
        latency: tuple[float, float] = (0.0, 0.0),
        start: RandomizationParams | None = None,
        motors: bool = False,
    ):
        """Build the simulator of an experiment's plant.

        Args:
            experiment: experiment with the plant.
            count: number E of vehicles. device: "cpu" or "cuda:0".
            seed: seed of the measurements' noise.
            noise: noise of the measurements, in SI units as in training; None for none.
            latency: range of each vehicle's age of measurements, drawn at a reset [s].
            start: if given, vehicles, ropes and initial states are those of
                :func:`visthrow.training.protocol.throw` with the same seed and start, and commands
                are disturbed as in training.
            motors: whether commands are motor-speed set-points [rad/s], shape (E, 4); see
                `sim.hybrid.HybridSim`.
        """
        from sim.hybrid import HybridSim, rope_variants

        self.params = plant_of(experiment)
        self.count = count
        self.noise = noise
        self.latency = latency
        self.period = self.params.sim.control_period
        self._start = start
        self._action = experiment.task.action
        ropes = None if start is None else rope_variants(self.params.rope, start)
        self._sim = HybridSim(self.params, count, device, seed, ropes=ropes, motors=motors)
        self._rng = np.random.default_rng(seed)
        self._command_bias = np.zeros((count, 4))
        if start is None:
            self.reset(np.tile([0.0, 0.0, experiment.task.start.spawn_height], (count, 1)))
        else:
            # twice, like ThrowEnv, which draws once in its constructor and once in its reset
            self._sim.randomize(start)
            self._sim.randomize(start)
            self._command_bias = noise.command_bias * self._rng.standard_normal((count, 4))
            self._begin()

    def reset(self, pos_w: ndarray, cable_dir_w: ndarray | None = None) -> None:
        self._sim.place(pos_w=pos_w + self.params.vehicle.body.com, cable_dir_w=cable_dir_w)
        self._begin()

    def _begin(self) -> None:
        self.time = 0.0
        count = self.count
        self._state: Snapshot | None = None  # state after the last step, computed on demand
        self._latched = np.zeros(count, bool)
        self._separation = np.full(count, np.nan)
        self._ropes: list[LooseRope | None] = [None] * count
        bias = 0.0 if self.noise is None else self.noise.observation_bias
        self._bias = bias * self._rng.standard_normal((5, count, 3))
        self._age = self._rng.uniform(*self.latency, count)
        self._error = np.zeros((5, count, 3))
        # newest first
        oldest = math.ceil(self.latency[1] / self.period - 1e-9)
        self._past = [self.state] * max(oldest, 1)

    def step(self, command: ndarray, release: ndarray | bool = False) -> None:
        release = np.broadcast_to(np.asarray(release, dtype=bool), (self.count,))
        if np.any(self._age):
            self._past = [self.state, *self._past[:-1]]
        self._sim.set_command(command if self._start is None else self._disturb(command), release)
        self._sim.step()
        self._state = None
        self._latched = self._latched | release
        separated = self._sim.get("separated") != 0
        landed = self.landing.landed
        for e, rope in enumerate(self._ropes):
            if rope is not None and not landed[e]:
                rope.fly(self.period)
            elif rope is None and separated[e]:
                separation_time = float(self._sim.get("separation_time")[e])
                self._separation[e] = self.time + separation_time
                loose = self._make_loose_rope(e)
                if self.period - separation_time > 1e-6:
                    loose.fly(self.period - separation_time)
                self._ropes[e] = loose
        self.time += self.period

    def hold(self, names: dict[str, ndarray] | None = None) -> dict[str, ndarray]:
        """Restore the state of vehicles and ropes that an earlier call returned, or only return
        it; motors and battery are not affected.
        """
        self._state = None
        for name, value in (names or {}).items():
            getattr(self._sim.state, name).assign(value)
        if names:
            self._sim.adopt()
        return names or {name: getattr(self._sim.state, name).numpy().copy() for name in BODIES}

    def look(self, *names: str) -> list[ndarray]:
        """Return arrays of the simulator's state, environment first; much cheaper than a
        snapshot.
        """
        return [self._sim.get(name).astype(float) for name in names]

    def stop_motors(self) -> None:
        """Set the rotors' speeds to zero."""
        self._state = None
        self._sim.state.motor_speed.zero_()

    def postpone(self, time: float) -> None:
        """Delay by a time [s] the separation of payloads whose latch tripped in the last period and
        that are still attached.
        """
        timer = self._sim.get("release_timer")
        waits = self._latched & (self._sim.get("attached") != 0) & (timer >= 0.0)
        later = np.where(waits, timer + time, timer).astype(timer.dtype)
        self._sim.state.release_timer.assign(later)

    def _disturb(self, command: ndarray) -> ndarray:
        """Return commands with the noise of training, which is added to normalised commands."""
        import torch

        from visthrow.onboard import actions as act

        max_thrust = self._action.max_thrust
        rates = torch.tensor(self._action.max_rate, dtype=torch.float64)
        undisturbed = torch.from_numpy(np.asarray(command, dtype=float))
        action = act.action_from_command(undisturbed, max_thrust, rates)
        noise = self.noise.command_step * self._rng.standard_normal((self.count, 4))
        action = action + torch.from_numpy(self._command_bias + noise)
        return act.command_from_action(action, max_thrust, rates).numpy()

    def _make_loose_rope(self, e: int) -> LooseRope:
        """Return the rope of one plant at separation; the simulator keeps the directions and rates
        of this instant.
        """
        rope = self.params.rope
        arrays = self.look("payload_pos_w", "payload_vel_w", "cable_dir_w", "cable_vel_w")
        ball, ball_vel, direction, turn = (array[e] for array in arrays)

        def upwards(end: ndarray, step: ndarray) -> ndarray:
            knot = end - rope.payload_offset * step[-1]
            above = knot - rope.segment_length * np.cumsum(step[::-1], axis=0)[::-1]
            return np.vstack((above, knot))

        return LooseRope(upwards(ball, direction), upwards(ball_vel, turn), ball, ball_vel)

    def _ball(self) -> tuple[ndarray, ndarray]:
        """Return the balls' positions and velocities, shape (E, 3); at rest after the landing."""
        landing = self.landing
        since = np.nan_to_num(self.time - self._separation)
        start = self.look("payload_pos_w", "payload_vel_w")
        pos, vel = fly_payloads(self.params.rope, self.params.air, *start, since)
        down = landing.landed[:, None]
        return np.where(down, landing.point_w, pos), np.where(down, 0.0, vel)

    @property
    def state(self) -> Snapshot:
        """Return the true state; all calls within a period return the same object."""
        self._state = self._state or self._snapshot()
        return self._state

    def _snapshot(self) -> Snapshot:
        ball, ball_vel = self._ball()
        points = self._sim.cable_points_w()
        for e, rope in enumerate(self._ropes):
            if rope is not None:
                points[e] = rope.points_w(ball[e])
        centre, quat, centre_vel, rate = self.look("pos_w", "quat_wb", "vel_w", "rate_b")
        com = np.array([self.params.vehicle.body.com])
        return Snapshot(
            self.time,
            pos_w=centre - rotate(quat, com),
            quat_wb=quat,
            vel_w=centre_vel - rotate(quat, cross(rate, com)),
            rate_b=rate,
            payload_pos_w=ball,
            payload_vel_w=ball_vel,
            cable_points_w=points,
            motor_speed=self.look("motor_speed")[0],
            battery_voltage=self.look("voltage")[0],
            attached=self._sim.get("attached") != 0,
            latched=self._latched.copy(),
        )

    def measure(self) -> Snapshot:
        """Return the delayed state with the observation noise of training; for the attitude the
        noise is a rotation angle [rad].
        """
        if self.noise is not None:
            step = self.noise.observation_step * self._rng.standard_normal((5, self.count, 3))
            self._error = self._bias + step
        return self._add_error(self.exposed)

    @property
    def exposed(self) -> Snapshot:
        return _delay([self.state, *self._past], self._age / self.period)

    @property
    def sample(self) -> Snapshot:
        """Return the current true state with the error of the last :meth:`measure`.

        The pilot receives it with a delay, interpolated between control steps as in training. A
        real sensor does not interpolate, so a log holds this sample."""
        return self._add_error(self.state)

    def _add_error(self, snapshot: Snapshot) -> Snapshot:
        if self.noise is None:
            return snapshot
        *errors, turn = self._error
        names = ("pos_w", "vel_w", "rate_b", "payload_pos_w")
        values = {name: getattr(snapshot, name) + error for name, error in zip(names, errors)}
        return replace(snapshot, **values, quat_wb=rotate_by_small_angles(snapshot.quat_wb, turn))

    @property
    def landing(self) -> PayloadLandings:
        impact = self._separation + self._sim.get("time_to_impact")
        landed = ~np.isnan(self._separation) & (impact <= self.time + 1e-9)
        point = np.where(landed[:, None], self.look("landing_w")[0], np.nan)
        when = np.where(landed, impact, np.nan)
        return PayloadLandings(landed, point, when, self._separation.copy())


class ReferenceAdapter:
    """The reference plant, with its fixed realistic extras, or with only the latency and payload
    drag of the policy's training.
    """

    def __init__(
        self, experiment: Experiment, count: int = 1, seed: int = 0, realistic: bool = True
    ):
        """Build the plant; ``realistic``: with the extras of
        ``configs/vehicle/reference_realistic.toml``.
        """
        from sim.reference.plant import ReferencePlant
        from sim.reference.reference_extras import ReferenceExtras

        latency = float(np.mean(experiment.task.observation.latency))
        extras = ReferenceExtras(mocap_latency=latency, payload_drag=experiment.rope.payload_drag)
        if realistic:
            extras = config.load(ReferenceExtras, config.find("vehicle", "reference_realistic"))
        self.name = "reference-realistic" if realistic else "reference"
        self.params = plant_of(experiment)
        self.count = count
        self.period = self.params.sim.control_period
        self._plant = ReferencePlant(self.params, extras, seed, count)
        self.reset(np.tile([0.0, 0.0, experiment.task.start.spawn_height], (count, 1)))

    def reset(self, pos_w: ndarray, cable_dir_w: ndarray | None = None) -> None:
        level = np.tile([0.0, 0.0, 0.0, 1.0], (self.count, 1))
        zero = np.zeros((self.count, 3))
        self._plant.reset(pos_w, level, zero, zero, cable_dir_w)

    def __getattr__(self, name: str) -> Any:
        """Return ``time``, ``step``, ``state``, ``exposed`` and ``landing`` of the plant."""
        return getattr(self._plant, name)

    def measure(self) -> Snapshot:
        """Return the newest sample that the plant's latency lets through."""
        self.sample = self._plant.measure()
        return self.sample


def fly_payloads(
    rope: RopeParams, air: AirParams, pos_w: ndarray, vel_w: ndarray, time: ndarray
) -> tuple[ndarray, ndarray]:
    """Return positions [m] and velocities [m/s] of payloads, shape (E, 3), after flights of a time
    [s], shape (E,), under gravity, wind and aerodynamic forces.
    """
    time = np.asarray(time, dtype=float)[:, None]
    if not (rope.payload_drag or rope.payload_side or rope.payload_lift):
        return free_flight(pos_w, vel_w, time), vel_w - time * [0.0, 0.0, GRAVITY]
    wind = np.array(air.wind_w)
    share, side, lift = (
        x / rope.payload_mass for x in (rope.payload_drag, rope.payload_side, rope.payload_lift)
    )

    def acceleration(v: ndarray) -> ndarray:
        airspeed = v - wind
        sideways = np.cross([0.0, 0.0, 1.0], airspeed)
        size = np.maximum(norm(sideways, axis=1, keepdims=True), 1e-12)
        turned = side * sideways + lift * np.cross(airspeed, sideways / size)
        speed = norm(airspeed, axis=1, keepdims=True)
        return speed * (turned - share * airspeed) - [0.0, 0.0, GRAVITY]

    count = max(int(np.ceil(np.max(time, initial=0.0) / FALL_STEP)), 1)
    h = time / count
    x = pos_w
    v = vel_w
    for _ in range(count):
        a = acceleration(v)
        b = acceleration(v + 0.5 * h * a)
        c = acceleration(v + 0.5 * h * b)
        d = acceleration(v + h * c)
        x = x + h * v + h**2 / 6.0 * (a + b + c)
        v = v + h / 6.0 * (a + 2.0 * b + 2.0 * c + d)
    return x, v


def make_plant(
    name: str, experiment: Experiment, count: int = 1, seed: int = 0, device: str = "cpu"
) -> Plant:
    """Build a plant by its name in :data:`PLANTS`; the training simulator has the task's noise and
    latency.
    """
    if check_plant(name) == "hybrid":
        task = experiment.task
        return HybridPlant(experiment, count, seed, device, task.noise, task.observation.latency)
    return ReferenceAdapter(experiment, count, seed, realistic=name == "reference-realistic")


def _delay(states: Sequence[Snapshot], age: ndarray) -> Snapshot:
    """Return states of an age in control periods, shape (E,), interpolated linearly between
    ``states`` one period apart, newest first.
    """
    newest = states[0]
    if not np.any(age):
        return newest
    row = np.minimum(age.astype(int), len(states) - 2)
    late = {}
    share = (age - row)[:, None]
    rows = np.arange(len(age))
    for name in ("pos_w", "quat_wb", "vel_w", "rate_b", "payload_pos_w", "payload_vel_w"):
        values = np.stack([getattr(state, name) for state in states])
        newer = values[row, rows]
        older = values[row + 1, rows]
        late[name] = newer + share * (older - newer)
    late["quat_wb"] /= norm(late["quat_wb"], axis=1, keepdims=True)
    return replace(newest, **late)


def random_ropes(rng: np.random.Generator, count: int, segments: int, angle: float) -> ndarray:
    """Return directions of straight ropes, tilted from the vertical by normal angles about two axes
    with standard deviation ``angle`` [rad], shape (E, L, 3).
    """
    tilt = angle * rng.standard_normal((count, 2))
    down = np.column_stack((tilt, -np.ones(count)))
    down /= norm(down, axis=1, keepdims=True)
    return np.repeat(down[:, None], segments, axis=1)
