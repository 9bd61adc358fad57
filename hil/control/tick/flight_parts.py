"""The parts of a runner that the steps of its ticks share."""

import math

from hil.control.aim import ReleaseCheck
from hil.control.calibrating import Calibrating
from hil.control.hovering import Hovering
from hil.control.latch import Latch
from hil.control.response import Response
from hil.control.state_machine import Machine
from hil.control.tick.body_estimate import Estimate
from hil.links.backends.base import Backend
from hil.params import HilParams
from hil.poses.body_track import Track
from hil.poses.detection import Detections
from hil.poses.pose import PAYLOAD, VEHICLE
from visthrow.onboard.pilot import Pilot
from visthrow.onboard.policy import Policy

CALM_OFFSET = 0.05
CALM_SPEED = 0.25
"""Limits for calm: distance of the vehicle from its hover point [m], and speed of vehicle and
payload over 0.2 s [m/s]. They are half of those from which the policies were trained to start.
"""


class FlightParts:
    """The parts that observe, check and command one vehicle.

    Attributes:
        params, backend, pilot, machine: of the run.
        tracks: by body.
        latch: of the release, with the landings so far. aim: checks releases.
        hovering: controller while no policy flies.
        response: check of the first hover; None for a dry run.
        detections: keypoints of a detector; None if there is none.
        calibrating: calibration in the hover; None unless the config requests it.
        mass: of vehicle, rope and payload [kg]. vehicle_mass: of the vehicle [kg].
        hang: of the payload's centre below the vehicle's at rest [m].
        thrust_tolerance: of the hover, relative to the weight.
        trained_age: of the poses in training [s].
        agreed: what the team agreed on for this tick; None without a team.
        spent: times of the last tick's stages [s].
    """

    def __init__(self, params: HilParams, policy: Policy, backend: Backend, mechanism_lag: float):
        """Build the parts; arguments and errors as of `hil.control.tick.runner.Runner`."""
        self.params = params
        self.backend = backend
        self.pilot = pilot = Pilot(policy, params.camera)
        delay = params.delay
        check = params.check
        contract = policy.contract
        rope = contract["rope"]
        dry = params.vehicle is None
        self.vehicle_mass = contract["vehicle"]["body"]["mass"]
        self.mass = self.vehicle_mass + rope["rope_mass"] + rope["payload_mass"]
        self.hang = -rope["mount"][2] + rope["length"] + rope["payload_offset"]
        tolerance = math.inf if dry else params.vehicle.thrust.tolerance
        self.thrust_tolerance = tolerance
        self.trained_age = 0.5 * sum(contract["observation"]["latency"])
        self.machine = Machine(params.states, params.throws, params.observe, not dry)
        self.tracks = {
            body: Track(frames, params.gate, params.estimate, body == VEHICLE)
            for body, frames in params.frames.items()
        }
        command_delay = delay.command if delay.compensate else 0.0
        height = params.landing_height
        limits = check.rope_tolerance, height, command_delay
        self.latch = Latch(pilot.lag, mechanism_lag, self.hang, *limits)
        self.aim = ReleaseCheck(params.aim, self.trained_age + self.latch.lag, height, rope)
        heading = math.radians(check.heading_deg)
        max_thrust = float(contract["action"]["max_thrust"])
        self.hovering = Hovering(params.home_w, heading, max_thrust, pilot.period)
        self.response = self.detections = self.calibrating = None
        if not dry:
            self.response = Response(pilot.period, self.mass, tolerance, check.probe)
        if params.keypoints == "detector":
            self.detections = Detections(pilot.camera, params.images.hold)
        if params.calibration is not None:
            self.calibrating = Calibrating(params.calibration)
        self.agreed: int | None = None
        self.spent: dict[str, float] = {}

    def carries_payload(self, estimate: Estimate) -> bool:
        """Return whether the payload hangs on the vehicle, by the latch and its own poses."""
        vehicle = estimate.vehicle
        payload = estimate.fresh_payload
        if vehicle is None:
            return self.latch.at is None
        place_w = None if payload is None else payload.pos
        return self.latch.payload_hangs(estimate.time, vehicle.pos, place_w)

    def is_calm(self, estimate: Estimate, holding: bool) -> bool:
        """Return whether the vehicle is at its hover point and nothing moves; with ``holding``, the
        autopilot holds the vehicle and its position does not count.
        """
        distance = math.dist(estimate.vehicle.pos, self.params.home_w)
        if not holding and distance > CALM_OFFSET:
            return False
        bodies = [VEHICLE]
        if self.latch.at is None and estimate.payload is not None:
            bodies.append(PAYLOAD)
        return all(self.tracks[body].calm_speed() < CALM_SPEED for body in bodies)
