"""Fly planned throws in the controller's pendulum model (idealised), and on the plants of
:mod:`visthrow.throws.plants`.

The model has no delays, no noise, no lag of the release and no aerodynamics, so its throws are an
upper bound. On the plants the pendulum's state is computed from the plant's measurements, including
the payload's velocity, and filtered by the model. To compensate known delays (measurement, command
queue, motors) the controller predicts the state through its model with the commands that have not
yet taken effect, and it trips the latch early by the release's lag."""

import math
from dataclasses import dataclass

import numpy as np
from numpy import ndarray
from numpy.linalg import norm

from sim.params import GRAVITY
from visthrow.common.rotations import matrix_of_quat
from visthrow.paper.baseline import pendulum_model as pm
from visthrow.paper.baseline.mpc import MPC, MPCParams, SolverError
from visthrow.paper.baseline.pendulum_model import Pendulum
from visthrow.paper.baseline.throw_plan import ThrowPlan, landing_point
from visthrow.task import Experiment
from visthrow.task.measurement import Throws, blank_failed, pilots_hover
from visthrow.throws.flight_loop import (
    FALL_TIME,
    Decision,
    Flight,
    Pilots,
    Scores,
    Smoothness,
    hover,
    throw,
)
from visthrow.throws.plants import HybridPlant, Plant, Snapshot
from visthrow.throws.reference_protocol import HOVER_TIME, batch_plant, place_in_hover

# Runge-Kutta steps of the simulated pendulum in one control period; the controller uses one
FINE = 4


SENT = 8  # number of last commands for the prediction; more than any delay covers

TRUST = np.repeat([0.2, 0.3, 0.15, 0.3, 0.5], [3, 3, 3, 3, 4])
"""Filter gains of payload position and velocity, cable direction and rate, and attitude: the
measurement's share in the estimate.
"""


@dataclass(frozen=True, kw_only=True)
class Flown(Throws):
    """Throws of one plan, scored like those of policies; the clearance is NaN in the model."""

    # payload's position error at separation, relative to the planned release [m], shape (N,)
    position_error: ndarray
    velocity_error: ndarray  # payload's velocity error at separation [m/s], shape (N,)
    # root mean square distance of the payload from the path until the release [m], shape (N,)
    tracking: ndarray
    step_times: ndarray  # computation times of all steps of the controller [s], shape (K,)


def _results_of(
    plan: ThrowPlan,
    success: ndarray,
    separated: tuple[ndarray, ndarray] | ndarray,
    step_times: list[float],
    **columns: ndarray,
) -> Flown:
    """Return the results of throws; ``separated``: positions [m] and velocities [m/s] of the
    payloads at separation.
    """
    pos_w, vel_w = separated
    columns["position_error"] = norm(pos_w - plan.release.pos_w, axis=1)
    columns["velocity_error"] = norm(vel_w - plan.release.vel_w, axis=1)
    columns = blank_failed(success, columns)
    return Flown(plan.target, success, **columns, step_times=np.array(step_times))


def _normalise(params: MPCParams, command: ndarray) -> ndarray:
    """Return commands (E, 4) normalised like a policy's actions."""
    throttle = np.sqrt(np.clip(command[:, :1], 0.0, params.max_thrust) / params.max_thrust)
    return np.hstack([2.0 * throttle - 1.0, command[:, 1:] / np.array(params.max_rate)])


def random_starts(plan: ThrowPlan, count: int, seed: int) -> ndarray:
    """Return random initial states in hover with the variation of ``configs/start/hover.toml``,
    shape (N, 16).

    Position and velocity of the payload, direction and rate of the cable, and attitude vary. The
    vehicle's mass, the cable's length and the battery, which also vary in training, are those of
    the model."""
    start = pilots_hover()
    rng = np.random.default_rng(seed)

    def sample(spread) -> ndarray:
        return np.asarray(spread) * rng.uniform(-1.0, 1.0, (count, 3))

    state, _ = pm.hover(plan.model, np.tile(plan.path.coefficients[0, 0], (count, 1)))
    state[:, pm.POS] += sample(start.position)
    state[:, pm.VEL] += sample(start.velocity)
    state[:, pm.DIR] += np.tan(math.radians(start.cable_angle_deg)) * sample([1.0, 1.0, 0.0])
    state[:, pm.RATE] = math.radians(start.cable_rate_deg) * sample([1.0, 1.0, 1.0])
    state[:, 12:15] = 0.5 * np.radians(sample(start.attitude_deg))
    pm.normalise(state.T)
    return state


def fly_pendulum(plan: ThrowPlan, count: int = 10, seed: int = 0) -> Flown:
    """Fly a plan ``count`` times in the controller's pendulum model.

    A throw fails if the controller's quadratic programme is not solved, the cable slackens or the
    payload never reaches the landing height. The release is at the planned time, possibly within a
    control period."""
    carry = plan.path.duration
    params = MPCParams()
    controller = MPC(plan.model, params)
    steps = math.ceil(carry / params.period - 1e-6)
    horizon = params.stages
    last = carry - (steps - 1) * params.period
    reference = plan.reference(0.0, params.period, steps + horizon)
    state = random_starts(plan, count, seed)
    good = np.ones(count, bool)
    tracking = np.zeros(count)
    times = []
    smoothness = np.full(count, np.nan)
    for e in range(count):
        controller.reset()
        change = Smoothness(_normalise(params, pm.hover(plan.model, state[e : e + 1, pm.POS])[1]))
        try:
            for k in range(steps):
                off = state[e, pm.POS] - reference[0][k, pm.POS]
                tracking[e] += off @ off
                command = controller.step(
                    state[e], (reference[0][k : k + horizon + 1], reference[1][k : k + horizon])
                )
                times.append(controller.step_time)
                change.add(_normalise(params, command[None]))
                good[e] &= pm.tension(plan.model, state[e], command) > 0.0
                state[e] = pm.step(
                    plan.model, state[e], command, params.period if k < steps - 1 else last, FINE
                )
        except SolverError:
            good[e] = False
        smoothness[e] = change.value[0]
    point, fall = landing_point(state[:, pm.POS], state[:, pm.VEL], plan.release.landing_height)
    good &= np.isfinite(fall)
    return _results_of(
        plan,
        good,
        (state[:, pm.POS], state[:, pm.VEL]),
        times,
        landing_w=point,
        error=norm(point - [plan.target, 0.0], axis=1),
        duration=carry + fall,
        clearance=np.full(count, np.nan),
        smoothness=smoothness,
        tracking=np.sqrt(tracking / steps),
    )


def pendulum_state(snapshot: Snapshot, mount_b: ndarray) -> ndarray:
    """Return the state of the pendulum from a plant's snapshot, with a straight cable from mount to
    payload, shape (E, 16).
    """
    rot = matrix_of_quat(snapshot.quat_wb)
    arm = rot @ mount_b
    cable = snapshot.payload_pos_w - snapshot.pos_w - arm
    length = norm(cable, axis=1, keepdims=True)
    moving = (
        snapshot.payload_vel_w
        - snapshot.vel_w
        - np.einsum("eij,ej->ei", rot, np.cross(snapshot.rate_b, mount_b))
    )
    direction = cable / length
    rate = np.cross(direction, moving) / length
    return np.concatenate(
        [snapshot.payload_pos_w, snapshot.payload_vel_w, direction, rate, snapshot.quat_wb], axis=1
    )


@dataclass(frozen=True)
class Delays:
    """Delays that the controller compensates [s]."""

    measurement: float = 0.0  # age of the measurement
    command: float = 0.0  # from a command to its effect
    release: float = 0.0  # from latch to separation


def delays_of(experiment: Experiment, compensation: str = "both") -> Delays:
    """Return the known delays of a plant to compensate: mean age of measurements; command queue,
    set-point filter and motors; release.

    ``compensation``: "none", as in the paper; "delay", all except the release's lag; "both".
    """
    vehicle = experiment.vehicle
    latency = experiment.task.observation.latency
    motors = vehicle.motor.time_constant if vehicle.motor.kind == "first_order" else 0.0
    if vehicle.controller.kind == "betaflight":
        setpoint = vehicle.controller.setpoint_time_constant
    else:
        setpoint = 0.0
    effect = vehicle.queue.delay + setpoint + motors
    means = (float(np.mean(latency)), effect) if compensation in ("delay", "both") else (0.0, 0.0)
    return Delays(*means, experiment.release.lag if compensation == "both" else 0.0)


def look_ahead(
    model: Pendulum,
    state: ndarray,
    sent: ndarray,
    period: float,
    begin: float,
    end: float = 0.0,
) -> ndarray:
    """Predict states, shape (E, 16), with the commands sent from ``begin`` to ``end`` [s] ago, each
    held for a period [s].

    ``sent``: commands sent one period ago, two periods ago and so on, shape (K, E, 4).
    """
    age = begin
    while age > end + 1e-9:
        k = max(math.ceil(age / period - 1e-9), 1)
        part = age - max((k - 1) * period, end)
        state = pm.step(model, state, sent[min(k, len(sent)) - 1], part)
        age -= part
    return state


def _start_plant(
    name: str, experiment: Experiment, target: float, batch: int, count: int, seed: int, device: str
) -> tuple[Plant, ndarray]:
    """Return a plant in the initial states of the policies' throws, and its hover point [m], shape
    (3,).
    """
    task = experiment.task
    start = pilots_hover()
    if name == "hybrid":
        plant = HybridPlant(
            experiment, count, seed, device, task.noise, task.observation.latency, start
        )
        return plant, np.array([0.0, 0.0, start.spawn_height])
    plant, rng = batch_plant(experiment, name, target, batch, count, seed)
    return plant, place_in_hover(plant, experiment, rng)


class Controllers(Pilots):
    """MPCs as the pilots of E vehicles, which track a plan and trip the latch at the planned time.

    Attributes: ``latch``: period of the throw in which the latch trips. ``most``: largest number of
    periods of a throw. ``times``: computation times of all steps [s]."""

    def __init__(
        self, plan: ThrowPlan, experiment: Experiment, period: float, delays: Delays, count: int
    ):
        """Prepare the controllers for a start in hover, with the experiment's limits, mount and
        release and a control period [s].
        """
        self.plan = plan
        self.delays = delays
        self.period = period
        action = experiment.task.action
        self.params = MPCParams(
            period=period, max_thrust=action.max_thrust, max_rate=action.max_rate
        )
        self.latch = round((plan.path.duration - delays.release) / period)
        self.most = self.latch + round((experiment.release.lag + FALL_TIME) / period) + 2
        self.times: list[float] = []
        self._mpc = [MPC(plan.model, self.params) for _ in range(count)]
        self._reference = plan.reference(delays.command, period, self.most + self.params.stages)
        self._hover = pm.hover(plan.model, np.zeros((count, 3)))[1]
        goal_w = np.tile([plan.target, 0.0, 0.0], (count, 1))
        super().__init__(experiment, goal_w, _normalise(self.params, self._hover))
        self._estimate: ndarray | None = None
        self._period = 0

    def decide(self, flight: Flight, snapshot: Snapshot, latched: ndarray) -> Decision:
        """Decide as `visthrow.throws.flight_loop.Pilots`. If a vehicle's quadratic programme is not
        solved, its throw has failed, and it hovers.
        """
        command = latched.copy()
        k = self._period
        n = self.params.stages
        sent = np.stack(
            [*flight.commands[: -SENT - 1 : -1], *[self._hover] * (SENT - len(flight.commands))]
        )
        span = self.delays.measurement + self.delays.command
        state = look_ahead(
            self.plan.model, self._correct_estimate(snapshot, sent, span), sent, self.period, span
        )
        reference = (self._reference[0][k : k + n + 1], self._reference[1][k : k + n])
        for e in np.flatnonzero(flight.flown):
            try:
                command[e] = self._mpc[e].step(state[e], reference)
                self.times.append(self._mpc[e].step_time)
            except SolverError as error:
                flight.fail(e, str(error))
        self._period += 1
        return Decision(
            command, np.full(len(command), k >= self.latch), _normalise(self.params, command)
        )

    def _correct_estimate(self, snapshot: Snapshot, sent: ndarray, span: float) -> ndarray:
        """Return the estimated state: the model's prediction from the previous period, corrected by
        the measurement.
        """
        measured = pendulum_state(snapshot, np.array(self.experiment.rope.mount))
        if self._estimate is None:
            self._estimate = measured
        predicted = look_ahead(
            self.plan.model, self._estimate, sent, self.period, span + self.period, span
        )
        side = np.sign((predicted[:, pm.QUAT] * measured[:, pm.QUAT]).sum(1, keepdims=True))
        measured[:, pm.QUAT] *= side
        estimate = predicted + TRUST * (measured - predicted)
        pm.normalise(estimate.T)
        self._estimate = estimate
        return estimate


class _Tracking(Scores):
    """Scores with the tracking errors of the payloads."""

    def __init__(self, pilots: Controllers):
        super().__init__(pilots)
        count = len(pilots.goal_w)
        self.pilots = pilots
        self.separated = np.full((2, count, 3), np.nan)
        self._sum = np.zeros(count)
        self._due = np.zeros(count)
        self._period = 0

    def after(self, flight: Flight, snapshot: Snapshot, sent: Decision) -> None:
        super().after(flight, snapshot, sent)
        if sent.action is None:
            return
        current = flight.now
        path = self.pilots.plan.path
        self._period += 1
        elapsed = self._period * flight.plant.period
        due = current.attached & (elapsed <= path.duration)
        off = current.payload_pos_w - path.sample(np.array([elapsed]))[0, 0]
        self._sum += due * (off**2).sum(1)
        self._due += due
        for e in np.flatnonzero(snapshot.attached & ~current.attached):
            since = flight.plant.time - flight.plant.landing.separation_time[e]
            vel = current.payload_vel_w[e] + np.array([0.0, 0.0, GRAVITY * since])
            self.separated[:, e] = (
                current.payload_pos_w[e] - since * 0.5 * (vel + current.payload_vel_w[e]),
                vel,
            )

    def collect_results(self, flight: Flight) -> Flown:
        """Return the results of all throws."""
        columns = self.columns(flight)
        columns["tracking"] = np.sqrt(self._sum / np.maximum(self._due, 1))
        plan = self.pilots.plan
        success = columns.pop("success")
        return _results_of(plan, success, self.separated, self.pilots.times, **columns)


def fly_plant(
    plan: ThrowPlan,
    plant_name: str,
    experiment: Experiment,
    delays: Delays,
    count: int,
    seed: int,
    batch: int = 0,
    device: str = "cpu",
) -> Flown:
    """Fly a plan on a plant of :data:`visthrow.throws.plants.PLANTS`, with these delays
    compensated.

    The conditions are those of policies with the same count and seed. In the training simulator
    they are the vehicles, ropes and initial states of :func:`visthrow.training.protocol.throw`. On
    a reference plant they are the vehicles, winds and initial states of batch ``batch`` of
    :mod:`visthrow.throws.reference_protocol`, after a hover under the hover controller."""
    plant, home = _start_plant(plant_name, experiment, plan.target, batch, count, seed, device)
    pilots = Controllers(plan, experiment, plant.period, delays, count)
    flight = Flight(plant, pilots, tracking := _Tracking(pilots), home)
    before = [] if plant_name == "hybrid" else [hover(HOVER_TIME)]
    flight.run([*before, throw(pilots.most * plant.period)])
    return tracking.collect_results(flight)
