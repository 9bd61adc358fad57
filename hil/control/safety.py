"""Output guard, geofences and pre-throw checks."""

import math
from dataclasses import dataclass

from hil.links.backends.base import Command
from hil.poses.body_track import BodyState
from hil.poses.pose import Vector
from visthrow.common.errors import ConfigError
from visthrow.common.rotations import tilt_and_heading
from visthrow.config.bounds import Bounded, NotNegative, Positive


@dataclass(frozen=True)
class GuardParams(Bounded):
    """Limits on the change of a command from one tick to the next.

    The limits of the commands themselves are those of the policy's training.
    """

    slew_thrust: Positive  # [N]
    slew_rate: tuple[Positive, Positive, Positive]  # [rad/s]


class Guard:
    """A filter that clips and slew-limits commands and refuses those that are not finite;
    ``clipped``, ``slewed`` and ``refused`` count them.
    """

    def __init__(self, params: GuardParams, max_thrust: float, max_rate: Vector):
        """Take the limits: collective thrust within 0 and ``max_thrust`` [N], body rates within
        ``max_rate`` [rad/s].
        """
        self._low, self._high = (0.0, *(-r for r in max_rate)), (max_thrust, *max_rate)
        self._slew = (params.slew_thrust, *params.slew_rate)
        self._last: Command | None = None
        self.clipped = self.slewed = self.refused = 0

    def reset(self) -> None:
        """Forget the last command: after a pause in the commands it limits nothing."""
        self._last = None

    def check(self, command: Command) -> Command | None:
        """Return the limited command [N, rad/s]; None if the command is not finite."""
        if len(command) != 4 or not all(map(math.isfinite, command)):
            self.refused += 1
            return None
        bounded = tuple(
            min(max(c, low), high) for c, low, high in zip(command, self._low, self._high)
        )
        self.clipped += bounded != command
        if self._last is not None:
            slow = tuple(
                min(max(c, last - s), last + s)
                for c, last, s in zip(bounded, self._last, self._slew)
            )
            self.slewed += slow != bounded
            bounded = slow
        self._last = bounded
        return bounded


@dataclass(frozen=True)
class FenceParams(Bounded):
    """Boxes in the world frame that vehicle and payload must not leave; the payload's contains the
    goal.
    """

    vehicle_low: Vector  # [m]
    vehicle_high: Vector  # [m]
    payload_low: Vector  # [m]
    payload_high: Vector  # [m]
    deceleration: Positive  # of the braking vehicle [m/s^2]

    def __post_init__(self) -> None:
        super().__post_init__()
        for body in ("vehicle", "payload"):
            lower = getattr(self, f"{body}_low")
            upper = getattr(self, f"{body}_high")
            if any(low >= high for low, high in zip(lower, upper)):
                raise ConfigError(
                    f"{body}_low is {lower} m, {body}_high {upper} m; expected ascending corners"
                )


def box_violation(point: Vector, low: Vector, high: Vector) -> str | None:
    """Return the first axis on which a point is outside a box, with its value; None inside."""
    for axis, x, lower, upper in zip("xyz", point, low, high):
        if not lower <= x <= upper:
            return f"{axis} {x:.2f} m beyond {lower:g} to {upper:g} m"
    return None


def fence_violation(
    params: FenceParams, vehicle: BodyState, payload: BodyState | None
) -> str | None:
    """Return which fence is violated, or would be at the end of braking; None if neither.
    ``payload`` is None while it flies freely.
    """
    stop = tuple(
        x + v * abs(v) / (2.0 * params.deceleration) for x, v in zip(vehicle.pos, vehicle.vel)
    )
    points = [("vehicle", vehicle.pos), ("vehicle's braking point", stop)]
    for name, point in points:
        violation = box_violation(point, params.vehicle_low, params.vehicle_high)
        if violation is not None:
            return f"{name} {violation}"
    if payload is None:
        return None
    violation = box_violation(payload.pos, params.payload_low, params.payload_high)
    return None if violation is None else f"payload {violation}"


@dataclass(frozen=True)
class CheckParams(Bounded):
    """Limits of the pre-throw checks. Each check finds a mistake that no single pose reveals."""

    tilt_deg: Positive  # of the vehicle: a wrong quaternion order shows it upside down
    # of the vehicle when it is set up: an error of 90 or 180 deg means exchanged axes or a wrong
    # quaternion order
    heading_deg: float
    heading_tolerance_deg: Positive
    # of the payload's distance from where it should hang [m]: bodies exchanged, marker lost
    rope_tolerance: Positive
    home_radius: Positive  # of the vehicle from its hover point [m]
    speed: Positive  # of the vehicle, noise included [m/s]
    # body rates of the doublets in the first hover that reveal the signs of the axes [rad/s]; 0:
    # none
    probe: NotNegative = 0.0


def failed_checks(
    params: CheckParams,
    fence: FenceParams,
    vehicle: BodyState,
    payload: BodyState,
    goal_w: Vector,
    home_w: Vector,
    hang: float,
) -> list[str]:
    """Return texts of the failed pre-throw checks; ``hang`` is the payload's distance below the
    vehicle at rest [m].
    """
    failed = []
    if vehicle.quat is None:
        return ["the vehicle's source gives no attitude"]
    tilt, heading = map(math.degrees, tilt_and_heading(vehicle.quat))
    if tilt > params.tilt_deg:
        failed.append(f"vehicle tilted by {tilt:.0f} deg (quaternion order or body axes wrong?)")
    error = (heading - params.heading_deg + 180.0) % 360.0 - 180.0
    if abs(error) > params.heading_tolerance_deg:
        failed.append(
            f"heading {heading:.0f} deg, not {params.heading_deg:g} (axes, yaw offset or quaternion"
            " wrong?)"
        )
    x, y, z = vehicle.pos
    offset = math.dist(payload.pos, (x, y, z - hang))
    if offset > params.rope_tolerance:
        failed.append(
            f"payload {offset:.2f} m from where it should hang (bodies exchanged, or an offset"
            " wrong?)"
        )
    distance = math.dist(vehicle.pos, home_w)
    if distance > params.home_radius:
        failed.append(f"vehicle {distance:.2f} m from its hover point")
    speed = math.hypot(*vehicle.vel)
    if speed > params.speed:
        failed.append(f"vehicle moves at {speed:.2f} m/s")
    goal_violation = box_violation(goal_w, fence.payload_low, fence.payload_high)
    if goal_violation is not None:
        failed.append(f"goal {goal_violation}")
    violation = fence_violation(fence, vehicle, payload)
    if violation is not None:
        failed.append(violation)
    return failed
