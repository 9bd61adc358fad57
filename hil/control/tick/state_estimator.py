"""Estimate: the first step of a tick, from poses and frames to the states of the bodies."""

import math
from collections.abc import Callable

from hil.control.state_machine import FLYING, State, TickRecord
from hil.control.tick.body_estimate import Estimate
from hil.control.tick.flight_parts import FlightParts
from hil.poses.body_track import BodyState, Track
from hil.poses.detection import Detection
from hil.poses.gate import HOLD, OK, Tether
from hil.poses.pose import GOAL, PAYLOAD, VEHICLE, Pose, Vector
from hil.poses.sources.images import Hint

# before the take-over, a body without an accepted pose for this long may reappear anywhere [s]
REACQUIRE = 1.0


class StateEstimator:
    """Estimates the bodies' states.

    Attributes:
        goal_w: target as of the last tick [m].
        watcher: called with body and track after each accepted pose; None: no call.
    """

    def __init__(self, parts: FlightParts):
        """Start without poses."""
        self.parts = parts
        self.goal_w: Vector | None = None
        self.watcher: Callable[[str, Track], None] | None = None
        self._detection: Detection | None = None
        rope = parts.pilot.policy.contract["rope"]
        length = math.hypot(*rope["mount"]) + rope["length"] + rope["payload_offset"]
        self._reach = length + parts.params.check.rope_tolerance  # of the cable [m]

    def take_poses(self, poses: list[Pose]) -> None:
        """Process raw poses."""
        parts = self.parts
        for pose in poses:
            track = parts.tracks.get(pose.body)
            if track is None or track.update(pose, self._tether(pose)) is not None:
                continue
            if self.watcher is not None:
                self.watcher(pose.body, track)
            if pose.body == PAYLOAD:
                time = pose.arrival - pose.transit(parts.params.delay.source)
                parts.latch.follow(time, track.gate.last.pos)

    def take_detections(self, detections: list[Detection]) -> None:
        """Process a camera's detections since the last tick; only the newest is kept."""
        if detections:
            self._detection = detections[-1]

    def estimate(self, time: float) -> Estimate:
        """Return the states of the bodies at a tick [s]."""
        parts = self.parts
        tracks = parts.tracks
        delay = parts.params.delay
        parts.latch.overdue(time)
        if parts.machine.state in (State.IDLE, State.CHECK):
            for track in tracks.values():
                # On the ground a body may be carried about without poses; in flight a jump stays
                # rejected.
                if REACQUIRE < track.gate.age(time) < math.inf:
                    track.restart()
        states = {body: self._state(track, time) for body, track in tracks.items()}
        self.goal_w = parts.params.goal_w
        if GOAL in tracks:
            self.goal_w = None if states[GOAL] is None else states[GOAL].pos
        age = self._age(tracks[VEHICLE], time)
        return Estimate(
            time,
            states[VEHICLE],
            states[PAYLOAD],
            self.goal_w,
            tracks[VEHICLE].gate.level(time),
            tracks[PAYLOAD].gate.level(time),
            tracks[GOAL].gate.level(time) if GOAL in tracks else OK,
            min(age, parts.trained_age) if delay.compensate else age,
        )

    def show_detection(self, estimate: Estimate, record: TickRecord) -> None:
        """Turn the newest detection into keypoints, and add it to the tick's record."""
        detections = self.parts.detections
        detection = self._detection
        self._detection = None
        if detections is None:
            return
        if detection is not None:
            record.detection = detection.values()
        vehicle = estimate.vehicle
        if estimate.has_attitude:
            detections.note_vehicle(estimate.time, vehicle.pos, vehicle.quat)
            if detection is not None:
                detections.take(detection, vehicle.quat, estimate.shown_age)

    def hint(self, time: float) -> Hint | None:
        """Return a hint for a detector: the vehicle's pose and, while the payload hangs, limits of
        its distance; None without a fresh pose.
        """
        track = self.parts.tracks[VEHICLE]
        hang = self.parts.hang
        vehicle = track.state(time)
        if vehicle is None or vehicle.quat is None or track.gate.level(time) >= HOLD:
            return None
        distances = (0.5 * hang, 1.4 * hang) if self.parts.latch.at is None else None
        return Hint(vehicle.pos, vehicle.quat, distances)

    def _tether(self, pose: Pose) -> Tether | None:
        """Return the cable's other end for a pose of vehicle or payload while the payload hangs;
        None on the ground and after the release.
        """
        partner = {VEHICLE: PAYLOAD, PAYLOAD: VEHICLE}.get(pose.body)
        parts = self.parts
        if partner is None or parts.latch.at is not None or parts.machine.state not in FLYING:
            return None
        track = parts.tracks[partner]
        pos = track.predict_position(pose.arrival)
        if pos is None:
            return None
        fresh = track.gate.level(pose.arrival) < HOLD
        return Tether(pos, self._reach if fresh else math.inf)

    def _state(self, track: Track, time: float) -> BodyState | None:
        """Return the state of a body, predicted to the age that the policy was trained with if the
        config requests it.
        """
        delay = self.parts.params.delay
        age = self._age(track, time)
        lead = 0.0
        if delay.compensate and math.isfinite(age):
            lead = age - self.parts.trained_age + delay.command
        return track.state(time, lead)

    def _age(self, track: Track, time: float) -> float:
        """Return the age of a body's last pose [s]."""
        last = track.gate.last
        source = self.parts.params.delay.source
        return track.gate.age(time) + (source if last is None else last.transit(source))
