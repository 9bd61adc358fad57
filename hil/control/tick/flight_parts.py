"""The parts of a runner that the steps of its ticks share."""

import math
from dataclasses import dataclass, field

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
"""Distance of the vehicle from its hover point [m], and speed of vehicle and payload over 0.2 s
[m/s], that count as calm: half of what the policies were trained to start from.
"""


@dataclass
class FlightParts:
    """One vehicle with what observes, judges and commands it."""

    params: HilParams
    backend: Backend
    pilot: Pilot
    machine: Machine
    tracks: dict[str, Track]  # by body
    latch: Latch  # of the release, with the landings so far
    aim: ReleaseCheck
    hovering: Hovering  # on poses, where no policy flies
    response: Response | None  # None for a dry run
    detections: Detections | None  # where keypoints are a detector's
    calibrating: Calibrating | None  # of the camera in the hover, where the config asks for it
    mass: float  # of vehicle, rope and payload [kg]
    vehicle_mass: float  # [kg]
    hang: float  # of the payload's centre below the vehicle's at rest [m]
    thrust_tolerance: float  # of the hover, relative to the weight
    trained_age: float  # of the poses in training [s]
    agreed: int | None = None  # by the team for this tick; None without a team
    spent: dict[str, float] = field(default_factory=dict)  # by the stages of the last tick [s]

    def carries_payload(self, estimate: Estimate) -> bool:
        """Return whether the payload hangs on the vehicle, by the latch and by its own poses."""
        vehicle = estimate.vehicle
        payload = estimate.fresh_payload
        if vehicle is None:
            return self.latch.at is None
        place_w = None if payload is None else payload.pos
        return self.latch.payload_hangs(estimate.time, vehicle.pos, place_w)

    def is_calm(self, estimate: Estimate, holding: bool) -> bool:
        """Return whether nothing moves, at the hover point or where the autopilot holds the vehicle
        by itself (``holding``).
        """
        distance = math.dist(estimate.vehicle.pos, self.params.home_w)
        if not holding and distance > CALM_OFFSET:
            return False
        bodies = [VEHICLE]
        if self.latch.at is None and estimate.payload is not None:
            bodies.append(PAYLOAD)
        return all(self.tracks[body].calm_speed() < CALM_SPEED for body in bodies)


def build_parts(
    params: HilParams, policy: Policy, backend: Backend, mechanism_lag: float
) -> FlightParts:
    """Build the parts of a runner; errors as of `hil.control.runner.Runner`."""
    pilot = Pilot(policy, params.camera)
    delay = params.delay
    check = params.check
    contract = policy.contract
    rope = contract["rope"]
    vehicle_mass = contract["vehicle"]["body"]["mass"]
    mass = vehicle_mass + rope["rope_mass"] + rope["payload_mass"]
    max_thrust = float(contract["action"]["max_thrust"])
    hang = -rope["mount"][2] + rope["length"] + rope["payload_offset"]
    dry = params.backend == "dry-run"
    tolerance = math.inf if dry else getattr(params, params.backend).thrust.tolerance
    command_delay = delay.command if delay.compensate else 0.0
    trained_age = 0.5 * sum(contract["observation"]["latency"])
    height = params.landing_height
    latch = Latch(pilot.lag, mechanism_lag, hang, check.rope_tolerance, height, command_delay)
    heading = math.radians(check.heading_deg)
    detections = None
    if params.keypoints == "detector":
        detections = Detections(pilot.camera, params.images.hold)
    return FlightParts(
        params,
        backend,
        pilot,
        Machine(params.states, params.throws, params.observe, not dry),
        {
            body: Track(frames, params.gate, params.estimate, body == VEHICLE)
            for body, frames in params.frames.items()
        },
        latch,
        ReleaseCheck(params.aim, trained_age + latch.lag, height, rope),
        Hovering(params.home_w, heading, max_thrust, pilot.period),
        None if dry else Response(pilot.period, mass, tolerance, check.probe),
        detections,
        None if params.calibration is None else Calibrating(params.calibration),
        mass,
        vehicle_mass,
        hang,
        tolerance,
        trained_age,
    )
