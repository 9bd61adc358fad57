"""Flight logs of a run, made of its folder: what later tools read of a flight on poses as they read
a simulated one.

Times are those of the measurements, on the runner's clock: a source's stamps, moved by what lies
between them and the arrivals less the transit (known by TIMESYNC, or the delay that the config
states), as the median over some poses about each. Where the payload let go and came down is found
in its own poses."""

import json
import math
from dataclasses import dataclass, field, replace
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

LEAD, AFTER = (
    2.0,
    0.5,
)  # a throw's log begins this long before it and ends this long after its recovery [s]
LEAST_STEP = (
    1e-6  # between two samples of a channel [s]: poses that were taken in together keep their order
)
SPUN_UP = math.log(100.0)
"""After an autopilot begins to follow, rotors that stood turn as the commands ask, to 1 % [lags of
a motor]; before that commands are no valid ones.
"""

# poses on either side that a clock's offset is the median of: jitter of the transport goes, drift
# stays
HALF_WINDOW = 25
AFTERWARDS = (State.THROW, State.RECOVER, State.ABORT)  # states that belong to a throw

STATES = tuple(state.value for state in State)


@dataclass
class PlayedRun:
    """A whole run, played back."""

    playback: Playback
    ticks: list[Tick]
    provenance: dict[str, Any]
    throws: list[tuple[int, int]] = field(
        default_factory=list
    )  # first tick in throw, last tick of its recovery

    def __post_init__(self) -> None:
        states = [tick.decision.state for tick in self.ticks]
        for n, state in enumerate(states):
            if state == State.THROW and (n == 0 or states[n - 1] != State.THROW):
                end = next(
                    (k for k in range(n, len(states)) if states[k] not in AFTERWARDS),
                    len(states) - 1,
                )
                self.throws.append((n, end))
        by_body: dict[str, list[Sample]] = {}
        for tick in self.ticks:
            for sample in tick.samples:
                by_body.setdefault(sample.body, []).append(sample)
        for samples in by_body.values():
            stamps = np.array([sample.pose.stamp for sample in samples])
            offsets = (
                np.array([measured(sample, self.playback.params) for sample in samples]) - stamps
            )
            around = np.pad(offsets, HALF_WINDOW, mode="edge")
            offset = np.median(
                np.lib.stride_tricks.sliding_window_view(around, 2 * HALF_WINDOW + 1), axis=1
            )
            for sample, time in zip(samples, stamps + offset):
                sample.time = float(time)


def measured(sample: Sample, params: HilParams) -> float:
    """Return when a pose was measured by its arrival alone [s]."""
    return sample.pose.arrival - sample.pose.transit(params.delay.source)


def read(folder: str | Path) -> PlayedRun:
    """Play a run back; raises `RunError` for what is no folder of a run, or a damaged one."""
    folder = Path(folder)
    params, policy, lines, poses = load_run(folder)
    if not lines:
        raise RunError(f"{folder}: the run ended before its first tick; there is nothing to show")
    playback = Playback(params, policy)
    provenance = _read_json(folder / PROVENANCE)
    provenance["simulated"] = any(
        link.get("simulated") for link in _read_json(folder / SUMMARY).get("links", [])
    )
    return PlayedRun(
        playback, [playback.feed(line, poses.get(line["n"], [])) for line in lines], provenance
    )


def _read_json(path: Path) -> dict[str, Any]:
    """Return what a file of a run says; nothing where the run was killed before it was written
    whole.
    """
    try:
        return json.loads(path.read_text(encoding="utf-8"))
    except (OSError, ValueError):
        return {}


class TickLogger:
    """Fills a recorder with ticks."""

    def __init__(self, playback: Playback, meta: dict) -> None:
        self.params, self.runner = playback.params, playback.runner
        self.recorder = FlightRecorder(meta)
        self._declare()
        self._last: dict[str, float] = {}
        self._vehicle: Pose | None = None  # the last one: where the rope hangs
        self._follows: float | None = None  # since when the autopilot does
        contract = self.runner.pilot.policy.contract
        self.spun_up = SPUN_UP * contract["vehicle"]["motor"]["time_constant"]
        self._mount_b = np.array(contract["rope"]["mount"], dtype=float)

    def flush(self) -> FlightLog:
        """Return the log of what was added since the last call."""
        log, self.recorder = self.recorder.log(), FlightRecorder(self.recorder.meta)
        self._declare()
        return log

    def _declare(self) -> None:
        for name in (VEHICLE, PAYLOAD, GOAL):
            self.recorder.declare(f"age_{name}", "s")
        self.recorder.declare("state", "1")

    def add(self, tick: Tick) -> None:
        """Add all that one tick holds."""
        attached = tick.attached
        for sample in tick.samples:
            self._pose(sample, attached)
        d, time = tick.decision, tick.line["time"]
        values: dict[str, Any] = {
            "mode": int(d.state == State.THROW),
            "state": STATES.index(d.state),
            "attached": attached,
            "release_command": float(d.release),
        }
        values |= {f"age_{name}": age for name, age in tick.ages.items() if np.isfinite(age)}
        if tick.goal_w is not None:
            values["goal_w"] = tick.goal_w
        if Status(*tick.line["status"]).mode != FOLLOW:
            self._follows = None
        elif self._follows is None:
            self._follows = time
        if d.command is not None:
            acts = self._follows is not None and time - self._follows >= self.spun_up - ROUNDING
            self.recorder.add(time, acts, command=np.array(d.command, dtype=float))
        for name in ("action", "observation", "keypoints"):
            if getattr(d, name) is not None:
                values[name] = np.array(getattr(d, name), dtype=float)
        if d.valid is not None:
            values["keypoints_valid"] = np.array(d.valid, dtype=bool)
        for name, seconds in tick.line["times"].items():
            self.recorder.declare(f"tick_{name}", "s")
            values[f"tick_{name}"] = seconds
        self.recorder.add(time, **values)

    def _pose(self, sample: Sample, attached: bool) -> None:
        pose = sample.pose
        time = measured(sample, self.params) if sample.time is None else sample.time
        time = self._last[sample.body] = max(
            time, self._last.get(sample.body, -np.inf) + LEAST_STEP
        )
        if sample.body == PAYLOAD:
            self.recorder.add(time, payload_pos_w=pose.pos, payload_vel_w=sample.vel_w)
            self._note(payload_vel_w=pose.vel)
            vehicle = self._vehicle
            if attached and vehicle is not None and vehicle.quat is not None:
                mount_w = matrix_of_quat(np.array([vehicle.quat]))[0] @ self._mount_b
                self.recorder.add(time, cable_points_w=np.stack([vehicle.pos + mount_w, pose.pos]))
        elif sample.body == VEHICLE:
            self._vehicle = pose
            self.recorder.add(time, pos_w=pose.pos, vel_w=sample.vel_w)
            if pose.quat is not None:
                self.recorder.add(time, quat_wb=pose.quat, rate_b=sample.rate_b)
            self._note(vel_w=pose.vel, rate_b=pose.rate)

    def _note(self, **source_values: Any) -> None:
        """Note in the metadata which channels are the runner's own, of what the source gave of
        each.
        """
        estimated = self.recorder.meta.setdefault("estimated", [])
        estimated += [
            name for name, value in source_values.items() if value is None and name not in estimated
        ]


def meta_of(playback: Playback, provenance: dict[str, Any], start: float) -> dict[str, Any]:
    """Return what is known of a run from its beginning on; ``start`` [s] is the zero of its
    pictures.
    """
    params, policy = playback.params, playback.runner.pilot.policy
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
    phases: list[list] = []
    for tick in ticks:
        phase = [tick.line["time"], tick.decision.state, tick.decision.reason]
        if not phases or phases[-1][1:] != phase[1:]:
            phases.append(phase)
    return phases


def log_of(played: PlayedRun, first: int, last: int, throw: int | None = None) -> FlightLog:
    """Return the log of the ticks from ``first`` to ``last``, both included; of one throw where its
    number is given.
    """
    ticks, runner = played.ticks[first : last + 1], played.playback.runner
    start = (
        played.ticks[played.throws[throw][0]].line["time"]
        if throw is not None
        else ticks[0].line["time"]
    )
    samples = TickLogger(played.playback, meta_of(played.playback, played.provenance, start))
    landings = (
        []
        if throw is None
        else [landing for landing in runner.latch.landings if abs(landing.start - start) < 1e-9]
    )
    landing = next(iter(landings), None)
    latch = next(
        (t.line["time"] for t in ticks if t.decision.release and t.line["time"] >= start), None
    )
    distance = (
        np.inf
        if latch is None
        else (landing.separation if landing and landing.separation else latch + runner.latch.lag)
    )
    for tick in ticks:
        samples.add(replace(tick, attached=tick.line["time"] < distance))
    meta = samples.recorder.meta
    meta["events"] = events(ticks)
    meta["goal_w"] = list(
        next(
            (t.goal_w for t in ticks if t.line["time"] >= start and t.goal_w),
            played.playback.params.goal_w,
        )
    )
    if throw is not None:
        _judge(samples.recorder, landing, latch, ticks, start)
    return samples.recorder.log()


def _judge(
    recorder: FlightRecorder,
    landing: Landing | None,
    latch: float | None,
    ticks: list[Tick],
    start: float,
) -> None:
    """Note how a throw ended."""
    after = [tick for tick in ticks if tick.line["time"] >= start]
    ended = next((tick for tick in after if tick.decision.state != State.THROW), after[-1])
    times: dict[str, Any] = {"policy_start": start, "latch": latch, "recovery": ended.line["time"]}
    times["end"] = ticks[-1].line["time"]
    landed = (
        np.inf if landing is None else landing.time
    )  # what happens once it is down takes nothing from the throw
    stopped = next(
        (
            t.decision.reason
            for t in after
            if t.decision.state == State.ABORT and t.line["time"] < landed
        ),
        None,
    )
    failure = stopped or (None if latch is not None else ended.decision.reason)
    result: dict[str, Any] = {
        "success": landing is not None and stopped is None,
        "failure": failure,
    }
    if landing is not None:
        times |= {"landing": landing.time, "separation": landing.separation or latch + landing.lag}
        result |= {
            "landing_w": list(landing.landing_w),
            "error": landing.error,
            "duration": landing.duration,
            "separation_found": landing.separation is not None,
        }
        recorder.add(landing.time, landing=landing.landing_w)
        recorder.add(times["separation"], separation=landing.separation_w or landing.landing_w)
    elif failure is None:
        result["failure"] = "no landing was seen in the payload's poses"
    result["hovering_again"] = any(t.decision.reason == "hovering again" for t in after)
    recorder.meta |= {"times": times, "result": result}


def throws(played: PlayedRun) -> list[FlightLog]:
    """Return a log a throw."""
    logs, before = [], 0
    for number, (first, last) in enumerate(played.throws):
        period = played.playback.runner.pilot.period
        begin = max(before, first - round(LEAD / period))
        until = (
            played.throws[number + 1][0] - 1
            if number + 1 < len(played.throws)
            else len(played.ticks) - 1
        )
        until = min(until, last + round(AFTER / period))
        logs.append(log_of(played, begin, until, number))
        before = until + 1
    return logs


def whole(played: PlayedRun) -> FlightLog:
    """Return one log of the whole run."""
    return log_of(played, 0, len(played.ticks) - 1)
