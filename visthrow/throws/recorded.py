"""Fly and record a throw, from a hover to a hover."""

from collections.abc import Callable
from typing import Any

import numpy as np
from numpy import ndarray

from visthrow import config
from visthrow.common import provenance
from visthrow.common.errors import ConfigError
from visthrow.logs.flightlog import Channel, FlightLog, FlightRecorder
from visthrow.throws.flight_loop import Decision, Flight, FlightObserver, Phase, Policies, Sight
from visthrow.throws.loading import Loaded
from visthrow.throws.loose_rope import LooseRope
from visthrow.throws.plants import PLANTS, Snapshot, make_plant, random_ropes

START_SPREAD = 0.10  # largest offset of the start from the hover point, on each axis [m]
START_SWING = 0.05  # standard deviation of the rope's angle at the start [rad]
HOVER_LEAST = 1.5  # shortest hover before the throw [s]
HOVER_MOST = 6.0  # longest hover before the throw [s]
QUIET_OFFSET = 0.03  # largest offset from the hover point of a quiet vehicle [m]
QUIET_SPEED = 0.12  # largest speed of a quiet payload, or of a recovered vehicle [m/s]
QUIET_TIME = 0.4  # time for which it must be quiet [s]
RECOVERY_MOST = 8.0  # longest recovery [s]
# height at which the rope is drawn where it would pass through the ground, which no plant simulates
# for ropes [m]
ROPE_ON_GROUND = 0.003
MEASURED = {"pos_w": "m", "quat_wb": "1", "vel_w": "m/s", "rate_b": "rad/s", "payload_pos_w": "m"}
"""Channel -> unit of quantities that are also recorded as measured, under ``measured_<name>``, with
the times of the measurements.
"""
TRUTH = (*MEASURED, "payload_vel_w", "motor_speed", "battery_voltage", "attached")
"""Channels of the true state."""


class ThrowRecorder(FlightObserver):
    """A recorder of one vehicle's flight log: the true state and the command at the start of each
    period, the rope, the camera's keypoints, and the time of the release command, ``latch`` [s].
    """

    def __init__(self, pilots: Policies, meta: dict[str, Any]):
        self.recorder = FlightRecorder(meta)
        self.pilots = pilots
        self.latch: float | None = None
        for name, unit in MEASURED.items():
            self.recorder.declare(f"measured_{name}", unit, "body" if name == "rate_b" else "world")
        self._resting: LooseRope | None = None
        self._before: Snapshot | None = None
        self._sampled = -np.inf  # stamp of the last measured sample [s]

    def before(self, flight: Flight, snapshot: Snapshot, sent: Decision) -> None:
        pilots = self.pilots
        state = flight.now
        self.add_truth(state)
        recorder = self.recorder
        recorder.add(state.time, command=sent.command[0], release_command=float(sent.release[0]))
        throws = sent.action is not None
        if sent.release[0] and self.latch is None:
            self.latch = state.time
        sighted = pilots.eyes.last_keypoints if pilots.eyes is not None and throws else None
        points, valid = sighted or pilots.pilots[0].see(
            snapshot.pos_w, snapshot.quat_wb, snapshot.payload_pos_w, pilots.goal_w
        )
        keypoints = {"keypoints": points[0], "keypoints_valid": valid[0]}
        recorder.add(state.time, goal_w=pilots.goal_w[0], mode=int(throws), **keypoints)
        if sent.action is not None and sent.observation is not None:
            recorder.add(state.time, action=sent.action[0], observation=sent.observation[0])
        self.sample(flight)

    def add_truth(self, state: Snapshot) -> None:
        """Record the true state."""
        self.recorder.add(state.time, **{name: getattr(state, name)[0] for name in TRUTH})

    def sample(self, flight: Flight) -> None:
        """Record the current rope and the last measurement, with the time of the measurement."""
        points = self._rope(flight)
        points[:, 2] = np.maximum(points[:, 2], ROPE_ON_GROUND)
        self.recorder.add(flight.now.time, cable_points_w=points)
        sample = flight.plant.sample
        if sample.time > self._sampled:
            values = {f"measured_{name}": getattr(sample, name)[0] for name in MEASURED}
            self.recorder.add(sample.time, **values)
            self._sampled = sample.time
        self._before = flight.now

    def _rope(self, flight: Flight) -> ndarray:
        """Return the current rope [m], shape (L + 1, 3). After the landing it sinks to the ground;
        the plants stop simulating it.
        """
        state = flight.now
        landing = flight.plant.landing
        before = self._before
        period = flight.plant.period
        if not landing.landed[0] or before is None:
            return np.array(state.cable_points_w[0])
        if self._resting is None:
            age = max(landing.time[0] - before.time, 1e-3)
            points = state.cable_points_w[0]
            ball = state.payload_pos_w[0]
            speed = (points - before.cable_points_w[0]) / age
            self._resting = LooseRope(points, np.clip(speed, -20.0, 20.0), ball, np.zeros(3))
            period = state.time - landing.time[0]
        if period > 1e-6:
            self._resting.sink(period, ROPE_ON_GROUND - state.payload_pos_w[0, 2])
        return self._resting.points_w(state.payload_pos_w[0])


def fly(
    loaded: Loaded,
    goal_w: ndarray,
    plant_name: str = "hybrid",
    seed: int = 0,
    device: str = "cpu",
    eyes: Sight | None = None,
) -> FlightLog:
    """Hover until the payload is quiet, throw, and hover at the start again.

    The policy flies until separation, then the hover controller does. The recorded keypoints are
    those that the pilot computes from measured poses, also for a state policy. Raises ConfigError:
    the goal is invalid or outside the vehicle's bounds.

    Args:
        loaded: policy and experiment.
        goal_w: goal on the ground [m], shape (3,).
        plant_name: name in :data:`visthrow.throws.plants.PLANTS`.
        seed: seed of start, plant and measurements. device: device of the training simulator.
        eyes: source of keypoints from rendered pictures of one vehicle; if given, these keypoints
            are recorded.

    Returns:
        The flight with all standard channels; ``meta["result"]`` holds the result of the throw,
        ``meta["times"]`` the times of its events.
    """
    check_goal(loaded, goal_w)
    experiment = loaded.experiment
    plant = make_plant(plant_name, experiment, 1, seed, device)
    home = np.array([0.0, 0.0, experiment.task.start.spawn_height])
    rng = np.random.default_rng(seed)
    place = home[None] + START_SPREAD * rng.uniform(-1, 1, (1, 3))
    plant.reset(place, random_ropes(rng, 1, experiment.rope.segments, START_SWING))
    pilots = Policies([loaded], np.asarray(goal_w, dtype=float)[None], draws=True, eyes=eyes)
    recording = ThrowRecorder(pilots, _meta(loaded, plant_name, goal_w, seed))
    flight = Flight(plant, pilots, recording, home)

    def is_quiet(snapshot: Snapshot) -> bool:
        return _speed(snapshot.payload_vel_w) < QUIET_SPEED

    def has_separated(flight: Flight) -> bool:
        return not np.any(flight.open & flight.now.attached)

    flight.run([_hover_until(is_quiet, home, HOVER_LEAST, HOVER_MOST), Phase(True, has_separated)])
    recovery = plant.time

    def has_recovered(snapshot: Snapshot) -> bool:  # and the payload is on the ground or at rest
        at_rest = plant.landing.landed[0] or snapshot.attached[0]
        return _speed(snapshot.vel_w) < QUIET_SPEED and bool(at_rest)

    flight.run([_hover_until(has_recovered, home, 0.0, RECOVERY_MOST)])
    return _finish(flight, recording, recovery)


def check_goal(loaded: Loaded, goal_w: ndarray) -> None:
    """Raise ConfigError for a goal that is not three finite numbers or is outside the vehicle's
    bounds.
    """
    goal_w = np.asarray(goal_w, dtype=float)
    limit = loaded.experiment.task.bounds.horizontal
    if goal_w.shape != (3,) or not np.all(np.isfinite(goal_w)):
        raise ConfigError(f"goal {goal_w}; expected three finite numbers [m]")
    distance = float(np.hypot(*goal_w[:2]))
    trained = loaded.experiment.task.start.goal_radius
    if distance > limit:
        where = f"the goal is {distance:g} m away; the vehicle's bounds are {limit:g} m"
        raise ConfigError(f"{where}, and '{loaded.name}' was trained on goals within {trained:g} m")


def _meta(loaded: Loaded, plant_name: str, goal_w: ndarray, seed: int) -> dict[str, Any]:
    return {
        "policy": loaded.name,
        "layout": loaded.policy.contract["observation"]["layout"],
        "plant": plant_name,
        "plant_meaning": PLANTS[plant_name][0],
        "goal_w": [float(x) for x in goal_w],
        "seed": seed,
        "config": config.to_dict(loaded.experiment),
        "provenance": provenance.collect(),
    }


def _hover_until(
    quiet: Callable[[Snapshot], bool], home: ndarray, shortest: float, longest: float
) -> Phase:
    """Return the phase of a hover that ends when the vehicle has been at ``home`` and quiet for
    :data:`QUIET_TIME`, within a shortest and a longest time [s].
    """
    calm = 0.0

    def is_finished(flight: Flight) -> bool:
        nonlocal calm
        close = np.linalg.norm(flight.now.pos_w[0] - home) < QUIET_OFFSET
        calm = calm + flight.plant.period if close and quiet(flight.now) else 0.0
        return flight.elapsed >= shortest - 1e-9 and (
            calm >= QUIET_TIME or flight.elapsed >= longest
        )

    return Phase(False, is_finished)


def _finish(flight: Flight, recording: ThrowRecorder, recovery: float) -> FlightLog:
    """Return the log with the last state and the result of the throw."""
    plant = flight.plant
    state = flight.now
    recorder = recording.recorder
    recording.add_truth(state)
    plant.measure()
    recording.sample(flight)
    landing = plant.landing
    failure = flight.failures[0]
    times = {
        "policy_start": flight.begin,
        "latch": recording.latch,
        "recovery": recovery,
        "end": plant.time,
    }
    result: dict[str, Any] = {"success": False, "failure": failure}
    if not np.isnan(landing.separation_time[0]):
        times["separation"] = float(landing.separation_time[0])
    if landing.landed[0]:
        point = landing.point_w[0]
        when = float(landing.time[0])
        times["landing"] = when
        recorder.add(when, landing=point)
        off = point[:2] - flight.pilots.goal_w[0, :2]
        result |= {
            "success": failure is None,
            "landing_w": point.tolist(),
            "error": float(np.hypot(*off)),
            "duration": when - flight.begin,
        }
    high = bool(state.pos_w[0, 2] > 0.5)
    result["hovering_again"] = _speed(state.vel_w) < 2 * QUIET_SPEED and high
    recorder.meta |= {"times": times, "result": result}
    log = recorder.log()
    begins = times.get("separation")
    if begins is not None:
        place = log["payload_pos_w"].at(begins)[None]
        log.channels["separation"] = Channel(np.array([begins]), place, "m", "world")
    return log


def _speed(vel_w: ndarray) -> float:
    """Return the speed of the only vehicle or payload [m/s]."""
    return float(np.linalg.norm(vel_w[0]))
