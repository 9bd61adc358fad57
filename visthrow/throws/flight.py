"""One throw from hover to the vehicle hovering again, recorded."""

from dataclasses import dataclass
from typing import Any

import numpy as np

from visthrow.common import provenance
from visthrow.common.errors import ConfigError
from visthrow.logs.flightlog import FlightLog, FlightRecorder
from visthrow.onboard.hover import HoverController, HoverParams
from visthrow.onboard.pilot import Pilot, PilotOutput
from visthrow.throws.loading import Loaded
from visthrow.throws.loose_rope import LooseRope
from visthrow.throws.plants import PLANTS, Plant, Snapshot, make_plant, random_ropes

START_SPREAD = 0.10  # of the start about the hover point [m]
START_SWING = 0.05  # of the rope at the start [rad]
HOVER_LEAST, HOVER_MOST = 1.5, 6.0  # time in hover before the throw [s]
QUIET_OFFSET, QUIET_SPEED = 0.03, 0.12  # vehicle off its hover point [m]; payload against the world [m/s]
QUIET_TIME = 0.4  # for which it must last [s]
RECOVERY_MOST = 8.0  # [s]
ROPE_ON_GROUND = (
    0.003  # height at which the rope is drawn where it would pass through the ground; no plant knows it [m]
)
MEASURED = ("pos_w", "quat_wb", "vel_w", "rate_b", "payload_pos_w")
"""Channels that are recorded a second time as measured, under ``measured_<name>``, stamped when the measured state was true."""


@dataclass
class _Ends:
    """Times of a flight on the plant's clock [s]; None where the event did not happen."""

    policy_start: float | None = None
    latch: float | None = None
    recovery: float | None = None
    failure: str | None = None


class _Recording:
    """Plant, recorder and the rope on the ground of one flight."""

    def __init__(self, plant: Plant, goal_w: np.ndarray, pilot: Pilot, meta: dict[str, Any]) -> None:
        self.plant, self.goal_w, self.pilot = plant, goal_w, pilot
        self.recorder = FlightRecorder(meta)
        units = {"pos_w": "m", "quat_wb": "1", "vel_w": "m/s", "rate_b": "rad/s", "payload_pos_w": "m"}
        for name in MEASURED:
            self.recorder.declare(f"measured_{name}", units[name], "body" if name == "rate_b" else "world")
        self._resting: LooseRope | None = None
        self._before: Snapshot | None = None
        self._sampled = -np.inf  # stamp of the last measured sample [s]

    def step(self, command: np.ndarray, release: bool, mode: int, measured: Snapshot, seen: PilotOutput | None) -> None:
        """Record the state now and what is sent, then advance the plant."""
        self.sample()
        time = self.plant.time
        extra: dict[str, Any] = {"command": command[0], "release_command": float(release), "mode": mode}
        if seen is not None:
            extra |= {"action": seen.action[0], "observation": seen.observation[0]}
        points, valid = self.pilot.see(measured.pos_w, measured.quat_wb, measured.payload_pos_w, self.goal_w)
        extra |= {"keypoints": points[0], "keypoints_valid": valid[0]}
        self.recorder.add(time, goal_w=self.goal_w, **extra)
        self.plant.step(command, np.array([release]))

    def sample(self) -> None:
        """Record the true state now, and the measured one that the pilot was told of last."""
        now = self.plant.state
        names = (
            "pos_w",
            "quat_wb",
            "vel_w",
            "rate_b",
            "payload_pos_w",
            "payload_vel_w",
            "motor_speed",
            "battery_voltage",
            "attached",
        )
        values = {name: getattr(now, name)[0] for name in names}
        values["cable_points_w"] = self._rope(now)
        values["cable_points_w"][:, 2] = np.maximum(values["cable_points_w"][:, 2], ROPE_ON_GROUND)
        self.recorder.add(now.time, **values)
        sample = self.plant.sample
        if sample.time > self._sampled:
            self.recorder.add(sample.time, **{f"measured_{name}": getattr(sample, name)[0] for name in MEASURED})
            self._sampled = sample.time
        self._before = now

    def _rope(self, now: Snapshot) -> np.ndarray:
        """Rope now; after the landing it sinks to the ground instead of standing still as the plants leave it."""
        if not self.plant.landing.landed[0]:
            return now.cable_points_w[0].copy()
        before, period = self._before, self.plant.period
        if self._resting is None:
            age = max(self.plant.landing.time[0] - before.time, 1e-3)
            points, ball = now.cable_points_w[0], now.payload_pos_w[0]
            speed = (points - before.cable_points_w[0]) / age
            self._resting = LooseRope(points, np.clip(speed, -20.0, 20.0), ball, np.zeros(3))
            period = now.time - self.plant.landing.time[0]
        if period > 1e-6:
            self._resting.sink(period, ROPE_ON_GROUND - now.payload_pos_w[0, 2])
        return self._resting.points_w(now.payload_pos_w[0])


def fly(
    loaded: Loaded, goal_w: np.ndarray, plant_name: str = "hybrid", seed: int = 0, device: str = "cpu"
) -> FlightLog:
    """Hover until the swing is quiet, throw, and hover again at the start.

    The throw ends at separation; from there the hover controller has the vehicle. Keypoints are those that the pilot
    computes from measured poses, and are recorded for a state policy too.

    Args:
        loaded: policy and experiment.
        goal_w: on the ground [m], shape (3,).
        plant_name: of :data:`visthrow.throws.plants.PLANTS`.
        seed: of start, plant and measurements.
        device: of the training simulator.

    Returns:
        The flight with all standard channels; ``meta["result"]`` says how it ended, ``meta["times"]`` when.

    Raises:
        ConfigError: the goal is not a point in reach of the vehicle's bounds.
    """
    check_goal(loaded, goal_w)
    experiment = loaded.experiment
    plant = make_plant(plant_name, experiment, 1, seed, device)
    pilot = Pilot(loaded.policy, experiment.camera)
    home = np.array([0.0, 0.0, experiment.task.start.spawn_height])
    rng = np.random.default_rng(seed)
    plant.reset(
        home[None] + START_SPREAD * rng.uniform(-1, 1, (1, 3)),
        random_ropes(rng, 1, experiment.rope.segments, START_SWING),
    )
    recording = _Recording(plant, np.asarray(goal_w, dtype=float), pilot, _meta(loaded, plant_name, goal_w, seed))
    ends = _Ends()
    _hover(recording, experiment, home)
    _throw(recording, experiment, ends)
    _recover(recording, experiment, home, ends)
    return _finished(recording, ends)


def check_goal(loaded: Loaded, goal_w: np.ndarray) -> None:
    """Refuse a goal that no throw reaches.

    Raises:
        ConfigError: not three finite numbers, or further than the vehicle may fly.
    """
    goal_w = np.asarray(goal_w, dtype=float)
    limit = loaded.experiment.task.bounds.horizontal
    if goal_w.shape != (3,) or not np.all(np.isfinite(goal_w)):
        raise ConfigError(f"goal {goal_w}; expected three finite numbers [m]")
    distance = float(np.hypot(*goal_w[:2]))
    trained = loaded.experiment.task.start.goal_radius
    if distance > limit:
        raise ConfigError(
            f"the goal lies {distance:g} m away; the vehicle may not leave {limit:g} m, and '{loaded.name}' was "
            f"trained on goals within {trained:g} m"
        )


def _meta(loaded: Loaded, plant_name: str, goal_w: np.ndarray, seed: int) -> dict[str, Any]:
    experiment = loaded.experiment
    from visthrow import config

    return {
        "policy": loaded.name, "layout": loaded.policy.contract["observation"]["layout"], "plant": plant_name,
        "plant_meaning": PLANTS[plant_name], "goal_w": [float(x) for x in goal_w], "seed": seed,
        "config": config.to_dict(experiment), "provenance": provenance.collect(),
    }  # fmt: skip


def _hover(recording: _Recording, experiment, home: np.ndarray) -> None:
    plant = recording.plant
    rope, body = experiment.rope, experiment.vehicle.body
    controller = HoverController(HoverParams(), plant.period)
    quiet = 0.0
    while plant.time < HOVER_LEAST - 1e-9 or (quiet < QUIET_TIME and plant.time < HOVER_MOST):
        seen = plant.measured()
        command = controller.step(
            seen.pos_w, seen.quat_wb, seen.vel_w, home, body.mass + rope.rope_mass + rope.payload_mass
        )
        recording.step(command, False, 0, seen, None)
        now = plant.state
        off = np.linalg.norm(now.pos_w[0] - home)
        still = off < QUIET_OFFSET and np.linalg.norm(now.payload_vel_w[0]) < QUIET_SPEED
        quiet = quiet + plant.period if still else 0.0


def _throw(recording: _Recording, experiment, ends: _Ends) -> None:
    from visthrow.throws.reference_protocol import failures

    plant, pilot = recording.plant, recording.pilot
    ends.policy_start = plant.time
    pilot.start()
    while True:
        seen = plant.measured()
        out = pilot.act(
            seen.pos_w, seen.quat_wb, seen.vel_w, seen.rate_b, seen.payload_pos_w, recording.goal_w, seen.attached
        )
        if out.release[0] and ends.latch is None:
            ends.latch = plant.time
        recording.step(out.command, bool(out.release[0]), 1, seen, out)
        now = plant.state
        if not now.attached[0]:
            break
        found = failures(experiment, now, plant.time - ends.policy_start)
        if found is not None and found[0]:
            ends.failure = found[0]
            break
    ends.recovery = plant.time


def _recover(recording: _Recording, experiment, home: np.ndarray, ends: _Ends) -> None:
    plant = recording.plant
    rope, body = experiment.rope, experiment.vehicle.body
    controller = HoverController(HoverParams(), plant.period)
    quiet, start = 0.0, plant.time
    while plant.time - start < RECOVERY_MOST and quiet < QUIET_TIME:
        seen = plant.measured()
        hangs = rope.rope_mass + rope.payload_mass if seen.attached[0] else 0.0
        command = controller.step(seen.pos_w, seen.quat_wb, seen.vel_w, home, body.mass + hangs)
        recording.step(command, False, 0, seen, None)
        now = plant.state
        calm = np.linalg.norm(now.pos_w[0] - home) < QUIET_OFFSET and np.linalg.norm(now.vel_w[0]) < QUIET_SPEED
        down = plant.landing.landed[0] or now.attached[0]
        quiet = quiet + plant.period if calm and down else 0.0


def _finished(recording: _Recording, ends: _Ends) -> FlightLog:
    plant, recorder = recording.plant, recording.recorder
    plant.measured()
    recording.sample()
    landing = plant.landing
    times = {"policy_start": ends.policy_start, "latch": ends.latch, "recovery": ends.recovery, "end": plant.time}
    result: dict[str, Any] = {"success": False, "failure": ends.failure}
    if not np.isnan(landing.separation_time[0]):
        times["separation"] = float(landing.separation_time[0])
    if landing.landed[0]:
        point, when = landing.point_w[0], float(landing.time[0])
        times["landing"] = when
        recorder.add(when, landing=point)
        off = point[:2] - recording.goal_w[:2]
        result |= {"success": ends.failure is None, "landing_w": point.tolist(), "error": float(np.hypot(*off)),
                   "duration": when - ends.policy_start}  # fmt: skip
    now = plant.state
    result["hovering_again"] = bool(np.linalg.norm(now.vel_w[0]) < 2 * QUIET_SPEED and now.pos_w[0, 2] > 0.5)
    recorder.meta |= {"times": times, "result": result}
    log = recorder.log()
    if "separation" not in times:
        return log
    with_separation = FlightRecorder(recorder.meta)
    payload = log["payload_pos_w"]
    at = [np.interp(times["separation"], payload.time, payload.values[:, i]) for i in range(3)]
    with_separation.add(times["separation"], separation=np.array(at))
    return FlightLog({**log.channels, **with_separation.log().channels}, recorder.meta)
