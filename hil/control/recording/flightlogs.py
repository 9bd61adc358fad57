"""Flight logs of a run, in the format of simulated ones, made by playing its folder back.

Times are those of the measurements, on the runner's clock: a source's stamps, shifted by the median
difference from the arrivals less the transit (by TIMESYNC, or the config's delay) over neighbouring
poses. Separation and landing come from the payload's own poses."""

import json
import math
from dataclasses import dataclass, field, replace
from itertools import groupby
from pathlib import Path
from typing import Any

import numpy as np

from hil.control.latch import Landing
from hil.control.recording.playback import Playback, Sample, Tick
from hil.control.recording.record import PROVENANCE, SUMMARY, load_run
from hil.control.state_machine import State
from hil.errors import RunError
from hil.links.backends.base import FOLLOW, ROUNDING, Status
from hil.params import HilParams
from hil.poses.pose import GOAL, PAYLOAD, VEHICLE, Pose
from visthrow import config
from visthrow.common.rotations import matrix_of_quat
from visthrow.logs.flightlog import FlightLog, FlightRecorder

# time in a throw's log before the throw and after its recovery [s]
LEAD_TIME = 2.0
TRAIL_TIME = 0.5
LEAST_STEP = 1e-6  # between two samples of a channel [s]: simultaneous poses keep their order
SPUN_UP = math.log(100.0)
"""Time in which rotors at rest reach the commanded speed to 1 %, after an autopilot begins to
follow [time constants of a motor]; until then commands are marked invalid.
"""

# poses on either side over which the median of a clock's offset is taken: it removes jitter and
# keeps drift
HALF_WINDOW = 25
THROW_STATES = (State.THROW, State.RECOVER, State.ABORT)

STATES = tuple(state.value for state in State)


@dataclass
class PlayedRun:
    """A whole run, played back."""

    playback: Playback
    ticks: list[Tick]
    provenance: dict[str, Any]
    # first tick of each throw, last tick of its recovery
    throws: list[tuple[int, int]] = field(default_factory=list)

    def __post_init__(self) -> None:
        states = [tick.decision.state for tick in self.ticks]
        for n, state in enumerate(states):
            if state == State.THROW and (n == 0 or states[n - 1] != State.THROW):
                end = n
                while end + 1 < len(states) and states[end + 1] in THROW_STATES:
                    end += 1
                self.throws.append((n, end))
        by_body: dict[str, list[Sample]] = {}
        for tick in self.ticks:
            for sample in tick.samples:
                by_body.setdefault(sample.body, []).append(sample)
        for samples in by_body.values():
            self._date(samples)

    def _date(self, samples: list[Sample]) -> None:
        """Set the times of a body's samples."""
        stamps = np.array([sample.pose.stamp for sample in samples])
        times = np.array([date_by_arrival(sample, self.playback.params) for sample in samples])
        padded = np.pad(times - stamps, HALF_WINDOW, mode="edge")
        windows = np.lib.stride_tricks.sliding_window_view(padded, 2 * HALF_WINDOW + 1)
        for sample, time in zip(samples, stamps + np.median(windows, axis=1)):
            sample.time = float(time)


def date_by_arrival(sample: Sample, params: HilParams) -> float:
    """Return the time of a pose's measurement [s], from its arrival and transit alone."""
    return sample.pose.arrival - sample.pose.transit(params.delay.source)


def read(folder: str | Path) -> PlayedRun:
    """Play a run back. Raises `RunError`: not the folder of a run, or a damaged one."""
    folder = Path(folder)
    params, policy, lines = load_run(folder)
    if not lines:
        raise RunError(f"{folder}: the run ended before its first tick; there is nothing to show")
    playback = Playback(params, policy)
    provenance = _read_json(folder / PROVENANCE)
    links = _read_json(folder / SUMMARY).get("links")
    provenance["simulated"] = any(link.get("simulated") for link in links or [])
    ticks = [playback.feed(line) for line in lines]
    return PlayedRun(playback, ticks, provenance)


def _read_json(path: Path) -> dict[str, Any]:
    """Return a file's content; empty if the run was killed before it was written."""
    try:
        return json.loads(path.read_text(encoding="utf-8"))
    except (OSError, ValueError):
        return {}


class TickLogger:
    """Adds ticks to a flight log."""

    def __init__(self, playback: Playback, provenance: dict[str, Any], start: float):
        """Start an empty log with the metadata known at a run's start; ``start`` [s] is the zero
        of its pictures.
        """
        self.params = playback.params
        self.recorder = FlightRecorder(_meta_of(playback, provenance, start))
        self._declare()
        self._times: dict[str, float] = {}  # time of each body's last sample [s]
        self._vehicle: Pose | None = None  # last pose, for the rope's mount
        self._follow_time: float | None = None  # when the autopilot began to follow [s]
        contract = playback.runner.pilot.policy.contract
        self._spin_up = SPUN_UP * contract["vehicle"]["motor"]["time_constant"]
        self._mount_b = np.array(contract["rope"]["mount"], dtype=float)

    def flush(self) -> FlightLog:
        """Return the log of the ticks since the last call."""
        log = self.recorder.log()
        self.recorder = FlightRecorder(self.recorder.meta)
        self._declare()
        return log

    def _declare(self) -> None:
        for name in (VEHICLE, PAYLOAD, GOAL):
            self.recorder.declare(f"age_{name}", "s")
        self.recorder.declare("state", "1")

    def add(self, tick: Tick) -> None:
        """Add a tick."""
        for sample in tick.samples:
            self._add_pose(sample, tick.attached)
        record = tick.decision
        time = tick.line["time"]
        values: dict[str, Any] = {
            "mode": int(record.state == State.THROW),
            "state": STATES.index(record.state),
            "attached": tick.attached,
            "release_command": float(record.release),
        }
        values |= {f"age_{name}": age for name, age in tick.ages.items() if np.isfinite(age)}
        if tick.goal_w is not None:
            values["goal_w"] = tick.goal_w
        if Status(*tick.line["status"]).mode != FOLLOW:
            self._follow_time = None
        elif self._follow_time is None:
            self._follow_time = time
        if record.command is not None:
            begin = math.inf if self._follow_time is None else self._follow_time + self._spin_up
            command = np.array(record.command, dtype=float)
            self.recorder.add(time, time >= begin - ROUNDING, command=command)
        for name in ("action", "observation", "keypoints"):
            if getattr(record, name) is not None:
                values[name] = np.array(getattr(record, name), dtype=float)
        if record.valid is not None:
            values["keypoints_valid"] = np.array(record.valid, dtype=bool)
        for name, seconds in tick.line["times"].items():
            self.recorder.declare(f"tick_{name}", "s")
            values[f"tick_{name}"] = seconds
        self.recorder.add(time, **values)

    def _add_pose(self, sample: Sample, attached: bool) -> None:
        pose = sample.pose
        body = sample.body
        add = self.recorder.add
        time = date_by_arrival(sample, self.params) if sample.time is None else sample.time
        time = max(time, self._times.get(body, -np.inf) + LEAST_STEP)
        self._times[body] = time
        if body == PAYLOAD:
            add(time, payload_pos_w=pose.pos, payload_vel_w=sample.vel_w)
            self._note_estimated(payload_vel_w=pose.vel)
            vehicle = self._vehicle
            if attached and vehicle is not None and vehicle.quat is not None:
                mount_w = matrix_of_quat(np.array([vehicle.quat]))[0] @ self._mount_b
                add(time, cable_points_w=np.stack([vehicle.pos + mount_w, pose.pos]))
        elif body == VEHICLE:
            self._vehicle = pose
            add(time, pos_w=pose.pos, vel_w=sample.vel_w)
            if pose.quat is not None:
                add(time, quat_wb=pose.quat, rate_b=sample.rate_b)
            self._note_estimated(vel_w=pose.vel, rate_b=pose.rate)

    def _note_estimated(self, **source_values: Any) -> None:
        """List the channels that the source does not measure in the metadata."""
        estimated = self.recorder.meta.setdefault("estimated", [])
        for name, value in source_values.items():
            if value is None and name not in estimated:
                estimated.append(name)


def _meta_of(playback: Playback, provenance: dict[str, Any], start: float) -> dict[str, Any]:
    """Return the metadata known at a run's start."""
    params = playback.params
    policy = playback.runner.pilot.policy
    goal_w = playback.runner.estimator.goal_w or params.goal_w
    simulated = ", of a simulated vehicle" if provenance.get("simulated") else ""
    return {
        "policy": provenance.get("policy", Path(params.policy).stem),
        "policy_sha256": provenance.get("policy_sha256"),
        "layout": policy.contract["observation"]["layout"],
        "plant": "poses",
        "seed": None,
        "plant_meaning": f"poses of {params.source.kind}, back-end {params.backend}{simulated}",
        "goal_w": list(goal_w),
        "home_w": list(params.home_w),
        "states": list(STATES),
        "config": config.to_dict(params),
        "provenance": provenance,
        "times": {"policy_start": start},
        "result": {"success": False, "failure": None},
        "events": [],
    }


def events(ticks: list[Tick]) -> list[list]:
    """Return time, state and reason of each change."""
    same = groupby(ticks, lambda tick: (tick.decision.state, tick.decision.reason))
    return [[next(group).line["time"], *change] for change, group in same]


def log_of(played: PlayedRun, first: int, last: int, throw: int | None = None) -> FlightLog:
    """Return the log of the ticks from ``first`` to ``last``, both included; ``throw``: index of
    the throw in them, if any.
    """
    ticks = played.ticks[first : last + 1]
    runner = played.playback.runner
    begin = first if throw is None else played.throws[throw][0]
    start = played.ticks[begin].line["time"]
    logger = TickLogger(played.playback, played.provenance, start)
    thrown = [tick for tick in ticks if tick.line["time"] >= start]
    landing: Landing | None = None
    if throw is not None:
        same = (entry for entry in runner.latch.landings if abs(entry.start - start) < 1e-9)
        landing = next(same, None)
    latch = next((tick.line["time"] for tick in thrown if tick.decision.release), None)
    separation = np.inf
    if latch is not None:
        separation = (landing and landing.separation) or latch + runner.latch.lag
    for tick in ticks:
        logger.add(replace(tick, attached=tick.line["time"] < separation))
    meta = logger.recorder.meta
    meta["events"] = events(ticks)
    goal_w = next((tick.goal_w for tick in thrown if tick.goal_w), played.playback.params.goal_w)
    meta["goal_w"] = list(goal_w)
    if throw is not None:
        _add_result(logger.recorder, landing, latch, thrown, start)
    return logger.recorder.log()


def _add_result(
    recorder: FlightRecorder,
    landing: Landing | None,
    latch: float | None,
    ticks: list[Tick],
    start: float,
) -> None:
    """Add the result of a throw, whose ticks begin at its start [s]."""
    recovery = next((tick for tick in ticks if tick.decision.state != State.THROW), ticks[-1])
    times: dict[str, Any] = {
        "policy_start": start,
        "latch": latch,
        "recovery": recovery.line["time"],
        "end": ticks[-1].line["time"],
    }
    # An abort after the landing does not invalidate the throw.
    landed = np.inf if landing is None else landing.time
    aborts = (
        tick.decision.reason
        for tick in ticks
        if tick.decision.state == State.ABORT and tick.line["time"] < landed
    )
    abort = next(aborts, None)
    failure = abort or (None if latch is not None else recovery.decision.reason)
    if failure is None and landing is None:
        failure = "no landing was seen in the payload's poses"
    result: dict[str, Any] = {
        "success": landing is not None and abort is None,
        "failure": failure,
    }
    if landing is not None:
        separation = landing.separation or latch + landing.lag
        times |= {"landing": landing.time, "separation": separation}
        result |= {
            "landing_w": list(landing.landing_w),
            "error": landing.error,
            "duration": landing.duration,
            "separation_found": landing.separation is not None,
        }
        recorder.add(landing.time, landing=landing.landing_w)
        recorder.add(separation, separation=landing.separation_w or landing.landing_w)
    reasons = {tick.decision.reason for tick in ticks}
    result["hovering_again"] = "hovering again" in reasons
    recorder.meta |= {"times": times, "result": result}


def throws(played: PlayedRun) -> list[FlightLog]:
    """Return one log for each throw."""
    logs = []
    begin = 0
    period = played.playback.runner.pilot.period
    begins = [first for first, _ in played.throws[1:]] + [len(played.ticks)]
    for number, ((first, last), following) in enumerate(zip(played.throws, begins)):
        end = min(following - 1, last + round(TRAIL_TIME / period))
        logs.append(log_of(played, max(begin, first - round(LEAD_TIME / period)), end, number))
        begin = end + 1
    return logs


def make_log(played: PlayedRun) -> FlightLog:
    """Return one log of the whole run."""
    return log_of(played, 0, len(played.ticks) - 1)
