"""Flies planned throws: in the controller's own pendulum (idealised), and on the plants behind :mod:`visthrow.throws.plants`.

The own model knows no delay, no noise, no lag of the release and no aerodynamics: what is flown there is an upper bound.
On the plants the pendulum's state is put together from what the plant measures, payload velocity included, and smoothed
by the model. To make up for delays the controller looks ahead by what it knows of them (measurement, command queue,
motors) through its own model under the commands on their way, and trips the latch early by the release's lag;
:data:`COMPENSATIONS` names which of the two it does.
"""

import math
from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np

from sim.params import RandomizationParams
from visthrow import config
from visthrow.baseline import pendulum as pm
from visthrow.baseline.mpc import MPC, MPCParams, SolverError
from visthrow.baseline.pendulum import Pendulum
from visthrow.baseline.plan import Plan
from visthrow.baseline.release import landing_point
from visthrow.common.errors import ConfigError, suggest
from visthrow.onboard.hover import HoverController, HoverParams, rot_from_quat
from visthrow.task import Experiment, plant_of
from visthrow.throws.plants import HybridPlant, Plant, Snapshot
from visthrow.throws.reference_protocol import FALL_TIME, FIELDS, HOVER_TIME, batch_plant, failures, place_in_hover

if TYPE_CHECKING:
    from visthrow.training.protocol import Throws

FINE = 4
"""Runge-Kutta steps of the flown pendulum in one control period; the controller predicts with one."""


TRUST = np.repeat([0.2, 0.3, 0.15, 0.3, 0.5], [3, 3, 3, 3, 4])
"""Share of a measurement in the estimate of payload position and velocity, cable direction and rate, and attitude."""


@dataclass(frozen=True)
class Flown:
    """Results of N throws of one plan; NaN where a throw failed.

    Attributes:
        success: shape (N,), bool.
        landing_w: [m], shape (N, 2). error: [m], shape (N,). duration: from start to landing [s], shape (N,).
        position_error: of the payload at separation against the planned release [m], shape (N,).
        velocity_error: the same [m/s], shape (N,).
        tracking: root mean square distance of the payload from the path until the release [m], shape (N,).
        smoothness: root mean square change of the normalised commands from step to step, shape (N,).
        clearance: least distance of the payload from the vehicle after separation [m], shape (N,); NaN in the own model.
        step_times: of all steps of the controller [s], shape (K,).
    """

    success: np.ndarray
    landing_w: np.ndarray
    error: np.ndarray
    duration: np.ndarray
    position_error: np.ndarray
    velocity_error: np.ndarray
    tracking: np.ndarray
    smoothness: np.ndarray
    clearance: np.ndarray
    step_times: np.ndarray

    def throws(self, target: float) -> "Throws":
        """The same as learnt policies are scored."""
        from visthrow.training.protocol import Throws

        return Throws(target, **{name: getattr(self, name) for name in FIELDS})

    def summary(self) -> dict[str, float]:
        """Mean and deviation of the successful throws; times of a step in ms."""
        good = self.success
        out: dict[str, float] = {"throws": len(good), "success": float(good.mean())}
        for name in ("error", "duration", "position_error", "velocity_error", "tracking"):
            values = getattr(self, name)[good]
            out |= {f"{name}_mean": float(values.mean()), f"{name}_std": float(values.std())} if good.any() else {}
        if len(self.step_times):
            out["step_p50_ms"], out["step_p99_ms"] = (1e3 * float(x) for x in np.percentile(self.step_times, (50, 99)))
        return out


def _flown(
    plan: Plan, good: np.ndarray, pos_w, vel_w, landing_w, duration, tracking, smoothness, clearance, step_times
) -> Flown:
    blank = np.where(good, 1.0, np.nan)
    landing = landing_w * blank[:, None]
    return Flown(
        good, landing, np.linalg.norm(landing - [plan.target, 0.0], axis=1), duration * blank,
        np.linalg.norm(pos_w - plan.release.pos_w, axis=1) * blank,
        np.linalg.norm(vel_w - plan.release.vel_w, axis=1) * blank, tracking * blank, smoothness * blank,
        clearance * blank, np.array(step_times),
    )  # fmt: skip


class _Smoothness:
    """Root mean square change of normalised commands, as :mod:`visthrow.training.protocol` measures it."""

    def __init__(self, params: MPCParams, first: np.ndarray) -> None:
        self._most, self._rate = params.max_thrust, np.array(params.max_rate)
        self._last = self._normalised(first)
        self._sum, self._steps = np.zeros(len(first)), np.zeros(len(first))

    def _normalised(self, command: np.ndarray) -> np.ndarray:
        throttle = np.sqrt(np.clip(command[:, :1], 0.0, self._most) / self._most)
        return np.hstack([2.0 * throttle - 1.0, command[:, 1:] / self._rate])

    def add(self, command: np.ndarray, active: np.ndarray | bool = True) -> None:
        """Count the commands (E, 4) of vehicles that are being flown."""
        now = self._normalised(command)
        self._sum += active * ((now - self._last) ** 2).mean(1)
        self._steps += active
        self._last = now

    @property
    def value(self) -> np.ndarray:
        """Shape (E,)."""
        return np.sqrt(self._sum / np.maximum(self._steps, 1))


def random_starts(plan: Plan, count: int, seed: int) -> np.ndarray:
    """Hover with the rest of a pilot's hover, by ``configs/start/hover.toml``: states, shape (N, 16).

    What varies between throws: position and velocity of the payload, direction and rate of the cable, attitude. The
    vehicle's mass, the cable's length and the battery, which vary in training too, are the model's own here.
    """
    start, rng = config.load(RandomizationParams, config.find("start", "hover")), np.random.default_rng(seed)

    def drawn(spread) -> np.ndarray:
        return np.asarray(spread) * rng.uniform(-1.0, 1.0, (count, 3))

    state, _ = pm.hover(plan.model, np.tile(plan.path.coefficients[0, 0], (count, 1)))
    state[:, pm.POS] += drawn(start.position)
    state[:, pm.VEL] += drawn(start.velocity)
    state[:, pm.DIR] += np.tan(math.radians(start.cable_angle_deg)) * drawn([1.0, 1.0, 0.0])
    state[:, pm.DIR] /= np.linalg.norm(state[:, pm.DIR], axis=1, keepdims=True)
    rate = math.radians(start.cable_rate_deg) * drawn([1.0, 1.0, 1.0])
    state[:, pm.RATE] = rate - (rate * state[:, pm.DIR]).sum(1, keepdims=True) * state[:, pm.DIR]
    state[:, 12:15] = 0.5 * np.radians(drawn(start.attitude_deg))
    state[:, pm.QUAT] /= np.linalg.norm(state[:, pm.QUAT], axis=1, keepdims=True)
    return state


def fly_pendulum(
    plan: Plan, count: int = 10, seed: int = 0, landing_height: float = 0.04, params: MPCParams | None = None
) -> Flown:
    """Fly a plan in the pendulum that the controller believes in.

    A throw fails when the controller's programme is not solved, the cable slackens or the payload falls short.

    Args:
        plan: of the throw; the release comes at its time, within a control period if need be.
        count: throws.
        seed: of the starts.
        landing_height: of the payload's centre at impact [m].
        params: of the controller.
    """
    params = params or MPCParams()
    controller = MPC(plan.model, params)
    steps, horizon = math.ceil(plan.path.duration / params.period - 1e-6), params.stages
    last = plan.path.duration - (steps - 1) * params.period
    reference = plan.reference(0.0, params.period, steps + horizon)
    state = random_starts(plan, count, seed)
    good, tracking, times = np.ones(count, bool), np.zeros(count), []
    smoothness = np.full(count, np.nan)
    for e in range(count):
        controller.reset()
        change = _Smoothness(params, pm.hover(plan.model, state[e : e + 1, pm.POS])[1])
        try:
            for k in range(steps):
                off = state[e, pm.POS] - reference[0][k, pm.POS]
                tracking[e] += off @ off
                command = controller.step(state[e], (reference[0][k : k + horizon + 1], reference[1][k : k + horizon]))
                times.append(controller.step_time)
                change.add(command[None])
                good[e] &= pm.tension(plan.model, state[e], command) > 0.0
                state[e] = pm.step(plan.model, state[e], command, params.period if k < steps - 1 else last, FINE)
        except SolverError:
            good[e] = False
        smoothness[e] = change.value[0]
    point, fall = landing_point(state[:, pm.POS], state[:, pm.VEL], landing_height)
    good &= np.isfinite(fall)
    return _flown(
        plan, good, state[:, pm.POS], state[:, pm.VEL], point, plan.path.duration + fall, np.sqrt(tracking / steps),
        smoothness, np.full(count, np.nan), times,
    )  # fmt: skip


def pendulum_state(snapshot: Snapshot, mount_b: np.ndarray) -> np.ndarray:
    """State of the pendulum as a plant shows it, cable straight from mount to payload, shape (E, 16)."""
    rot = rot_from_quat(snapshot.quat_wb)
    arm = rot @ mount_b
    cable = snapshot.payload_pos_w - snapshot.pos_w - arm
    length = np.linalg.norm(cable, axis=1, keepdims=True)
    moving = snapshot.payload_vel_w - snapshot.vel_w - np.einsum("eij,ej->ei", rot, np.cross(snapshot.rate_b, mount_b))
    direction = cable / length
    rate = np.cross(direction, moving) / length
    return np.concatenate([snapshot.payload_pos_w, snapshot.payload_vel_w, direction, rate, snapshot.quat_wb], axis=1)


@dataclass(frozen=True)
class Delays:
    """What the controller makes up for [s]."""

    measurement: float = 0.0  # age of what it is told
    command: float = 0.0  # from a command to its effect
    release: float = 0.0  # from the latch to separation


COMPENSATIONS = ("none", "release", "delay", "both")
"""What is made up for: nothing, as in the paper; the release's lag; delays of measurement, command and motors; all."""


def delays_of(experiment: Experiment, compensation: str = "both") -> Delays:
    """Known delays of a plant: mean age of measurements; command queue, set-point filter and motors; release.

    Raises:
        ConfigError: no compensation of that name.
    """
    if compensation not in COMPENSATIONS:
        raise ConfigError(f"no compensation '{compensation}'; {suggest(compensation, COMPENSATIONS)}")
    vehicle, told = experiment.vehicle, experiment.task.observation.latency
    motors = vehicle.motor.time_constant if vehicle.motor.kind == "first_order" else 0.0
    setpoint = vehicle.controller.setpoint_time_constant if vehicle.controller.kind == "betaflight" else 0.0
    effect = vehicle.queue.delay + setpoint + motors
    across = (float(np.mean(told)), effect) if compensation in ("delay", "both") else (0.0, 0.0)
    return Delays(*across, experiment.release.lag if compensation in ("release", "both") else 0.0)


def look_ahead(model: Pendulum, state: np.ndarray, sent: np.ndarray, period: float, delays: Delays) -> np.ndarray:
    """Predict states from when they were measured to when a command given now takes effect.

    Args:
        model: of the prediction.
        state: as measured, ``delays.measurement`` ago, shape (E, 16).
        sent: commands given one period ago, two periods ago and so on, shape (K, E, 4).
        period: of the commands [s].
        delays: to look across.
    """
    return _under(model, state, sent, period, delays.measurement + delays.command, 0.0)


def _under(model: Pendulum, state: np.ndarray, sent: np.ndarray, period: float, begin: float, end: float) -> np.ndarray:
    """Predict states under the commands that were given from ``begin`` to ``end`` [s] ago, each held for a period."""
    age = begin
    while age > end + 1e-9:
        k = max(math.ceil(age / period - 1e-9), 1)
        part = age - max((k - 1) * period, end)
        state = pm.step(model, state, sent[min(k, len(sent)) - 1], part)
        age -= part
    return state


def _started(
    name: str, experiment: Experiment, start: RandomizationParams, target: float, batch: int, count: int, seed: int,
    device: str,
) -> Plant:  # fmt: skip
    """Plant at the start of the throws that learnt policies meet."""
    task = experiment.task
    if name == "hybrid":
        return HybridPlant(experiment, count, seed, device, task.noise, task.observation.latency, start)
    plant, rng = batch_plant(experiment, name, target, batch, count, seed)
    place_in_hover(plant, experiment, start, rng)
    return plant


class _PlantFlight:
    """State of a batch of throws on a plant."""

    def __init__(
        self,
        plan: Plan,
        plant_name: str,
        experiment: Experiment,
        delays: Delays,
        count: int,
        seed: int,
        batch: int = 0,
        device: str = "cpu",
    ) -> None:
        start = config.load(RandomizationParams, config.find("start", "hover"))
        self.plan, self.experiment, self.delays, self.count = plan, experiment, delays, count
        self.plant = _started(plant_name, experiment, start, plan.target, batch, count, seed, device)
        self.params = MPCParams(period=self.plant.period, max_thrust=experiment.task.action.max_thrust,
                                max_rate=experiment.task.action.max_rate)  # fmt: skip
        self.mount = np.array(plant_of(experiment).rope.mount)
        self.home = np.array([0.0, 0.0, start.spawn_height])
        self.controllers = [MPC(plan.model, self.params) for _ in range(count)]
        self.hovering = HoverController(HoverParams(), self.plant.period, count)
        hover = pm.hover(plan.model, np.zeros((count, 3)))[1]
        self.sent = np.tile(hover, (8, 1, 1))
        self.change = _Smoothness(self.params, hover)
        self.estimate: np.ndarray | None = None
        self.failed, self.flying = np.zeros(count, bool), np.ones(count, bool)
        self.separated = np.full((2, count, 3), np.nan)
        self.clearance = np.full(count, np.inf)
        self.tracking, self.tracked, self.times = np.zeros(count), np.zeros(count), []

    def hold(self, seen: Snapshot) -> np.ndarray:
        """Command that hovers at the start."""
        rope = self.experiment.rope
        mass = self.experiment.vehicle.body.mass + np.where(seen.attached, rope.rope_mass + rope.payload_mass, 0.0)
        return self.hovering.step(seen.pos_w, seen.quat_wb, seen.vel_w, self.home, mass)

    def send(self, command: np.ndarray, release: np.ndarray) -> None:
        """Advance the plant by one period."""
        self.sent = np.concatenate([command[None], self.sent[:-1]])
        self.plant.step(command, release)

    def throw(self, k: int, reference: tuple[np.ndarray, np.ndarray], latch: int) -> None:
        """Period k of the throw: the controller flies what it holds, the hover controller the rest."""
        seen = self.plant.measured()
        active = self.flying & seen.attached & ~self.failed
        command = self.hold(seen)
        state = look_ahead(self.plan.model, self._estimated(seen), self.sent, self.plant.period, self.delays)
        n = self.params.stages
        for e in np.flatnonzero(active):
            try:
                command[e] = self.controllers[e].step(state[e], (reference[0][k : k + n + 1], reference[1][k : k + n]))
                self.times.append(self.controllers[e].step_time)
            except SolverError:
                self.failed[e] = True
        before = self.plant.state.attached
        self.change.add(command, active)
        self.send(command, active & (k >= latch))
        self._watch(k, before)

    def _estimated(self, seen: Snapshot) -> np.ndarray:
        """State now: the model's prediction from the period before, corrected by what is measured."""
        measured = pendulum_state(seen, self.mount)
        if self.estimate is None:
            self.estimate = measured
        span = self.delays.measurement + self.delays.command
        then = _under(self.plan.model, self.estimate, self.sent, self.plant.period, span + self.plant.period, span)
        side = np.sign((then[:, pm.QUAT] * measured[:, pm.QUAT]).sum(1, keepdims=True))
        measured[:, pm.QUAT] *= side
        estimate = then + TRUST * (measured - then)
        for part in (pm.DIR, pm.QUAT):
            estimate[:, part] /= np.linalg.norm(estimate[:, part], axis=1, keepdims=True)
        direction = estimate[:, pm.DIR]
        estimate[:, pm.RATE] -= (estimate[:, pm.RATE] * direction).sum(1, keepdims=True) * direction
        self.estimate = estimate
        return estimate

    def _watch(self, k: int, before: np.ndarray) -> None:
        """Record separations and failures."""
        plant, now, landing = self.plant, self.plant.state, self.plant.landing
        elapsed = (k + 1) * plant.period
        due = now.attached & (elapsed <= self.plan.path.duration)
        off = now.payload_pos_w - self.plan.path.sample(np.array([elapsed]))[0, 0]
        self.tracking += due * (off**2).sum(1)
        self.tracked += due
        for e in np.flatnonzero(before & ~now.attached):
            back = plant.time - landing.separation_time[e]
            vel = now.payload_vel_w[e] + np.array([0.0, 0.0, 9.81 * back])
            self.separated[:, e] = now.payload_pos_w[e] - back * 0.5 * (vel + now.payload_vel_w[e]), vel
        apart = np.linalg.norm(now.payload_pos_w - now.pos_w, axis=1)
        away = ~now.attached & ~landing.landed
        self.clearance = np.where(away, np.minimum(self.clearance, apart), self.clearance)
        messages = failures(self.experiment, now, elapsed)
        self.failed |= np.array([message is not None for message in messages]) & now.attached & self.flying
        gone = ~now.attached & ~landing.landed & (plant.time - np.nan_to_num(landing.separation_time) > FALL_TIME)
        self.failed |= gone
        self.flying &= ~(self.failed | landing.landed)


def fly_plant(
    plan: Plan, plant_name: str, experiment: Experiment, delays: Delays, count: int = 10, seed: int = 0, batch: int = 0,
    device: str = "cpu",
) -> Flown:  # fmt: skip
    """Fly a plan on a plant of :data:`visthrow.throws.plants.PLANTS`.

    The throws are those that learnt policies meet with the same count and seed: in the training simulator the same vehicles,
    ropes and starts as :func:`visthrow.training.protocol.throw`, on a reference plant the same vehicles, winds and starts as
    :mod:`visthrow.throws.reference_protocol`, from hover under the hover controller.

    Args:
        plan: of the throw.
        plant_name: of the plant.
        experiment: whose plant, bounds and delays they are.
        delays: that the controller makes up for; ``Delays()`` for none.
        count: throws, flown as one batch.
        seed: of everything random.
        batch: number of the batch on a reference plant, as :mod:`visthrow.throws.reference_protocol` counts them.
        device: of the training simulator.
    """
    flight = _PlantFlight(plan, plant_name, experiment, delays, count, seed, batch, device)
    plant, period = flight.plant, flight.plant.period
    if plant_name != "hybrid":
        for _ in range(round(HOVER_TIME / period)):
            flight.send(flight.hold(plant.measured()), np.zeros(count, bool))
    began = plant.time
    latch = round((plan.path.duration - delays.release) / period)
    limit = latch + round((experiment.release.lag + FALL_TIME) / period) + 2
    reference = plan.reference(delays.command, period, limit + flight.params.stages)
    for k in range(limit):
        if not flight.flying.any():
            break
        flight.throw(k, reference, latch)
    landing = plant.landing
    good = landing.landed & ~flight.failed
    tracking = np.sqrt(flight.tracking / np.maximum(flight.tracked, 1))
    return _flown(
        plan, good, *flight.separated, landing.point_w[:, :2], landing.time - began, tracking, flight.change.value,
        flight.clearance, flight.times,
    )  # fmt: skip
