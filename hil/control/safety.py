"""What stands between a decision and the vehicle: output guard, geofences, checks before flight."""

import math
from dataclasses import dataclass

from hil.poses.pose import Vector
from hil.poses.track import BodyState
from visthrow.common.errors import ConfigError
from visthrow.common.rotations import tilt_and_heading
from visthrow.config.bounds import Bounded, NotNegative, Positive


@dataclass(frozen=True)
class GuardParams(Bounded):
    """Limits on the change of a command from one tick to the next.

    Its bounds are those of the policy's training.
    """

    slew_thrust: Positive  # [N]
    slew_rate: tuple[Positive, Positive, Positive]  # [rad/s]


class Guard:
    """Clips and slew-limits commands, and refuses those that are not finite; counts what it
    clipped, slewed and refused.
    """

    def __init__(self, params: GuardParams, max_thrust: float, max_rate: Vector) -> None:
        """Take the limits: collective thrust within 0 and ``max_thrust`` [N], body rates within
        ``max_rate`` [rad/s].
        """
        self._low, self._high = (0.0, *(-r for r in max_rate)), (max_thrust, *max_rate)
        self._slew = (params.slew_thrust, *params.slew_rate)
        self._last: tuple[float, ...] | None = None
        self.clipped = self.slewed = self.refused = 0

    def reset(self) -> None:
        """Forget the last command: after a silence nothing is known of what the vehicle does."""
        self._last = None

    def check(self, command: tuple[float, ...]) -> tuple[float, ...] | None:
        """Return the command that may be sent, [N, rad/s], or None where it is not finite."""
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
    """Boxes in our world that vehicle and payload may not leave, and the goal may not lie outside
    of.
    """

    vehicle_low: tuple[float, float, float]  # [m]
    vehicle_high: tuple[float, float, float]  # [m]
    payload_low: tuple[float, float, float]  # [m]
    payload_high: tuple[float, float, float]  # [m]
    deceleration: Positive  # that the vehicle brakes with [m/s^2]

    def __post_init__(self) -> None:
        super().__post_init__()
        for body, lowest, highest in (
            ("vehicle", self.vehicle_low, self.vehicle_high),
            ("payload", self.payload_low, self.payload_high),
        ):
            if any(low >= high for low, high in zip(lowest, highest)):
                raise ConfigError(
                    f"{body}_low is {lowest} m, {body}_high {highest} m; expected ascending corners"
                )


def outside(point: Vector, low: Vector, high: Vector) -> str | None:
    """Return the first axis along which a point lies outside of a box, with its value;
    None inside.
    """
    for axis, x, lowest, highest in zip("xyz", point, low, high):
        if not lowest <= x <= highest:
            return f"{axis} {x:.2f} m beyond {lowest:g} to {highest:g} m"
    return None


def fence_broken(params: FenceParams, vehicle: BodyState, payload: BodyState | None) -> str | None:
    """Return which fence is broken, or will be at the end of braking, or None.

    A payload that flies freely, None, cannot brake.
    """
    stop = tuple(
        x + v * abs(v) / (2.0 * params.deceleration) for x, v in zip(vehicle.pos, vehicle.vel)
    )
    bodies = [("vehicle", vehicle.pos, "vehicle"), ("vehicle's braking point", stop, "vehicle")]
    bodies += [] if payload is None else [("payload", payload.pos, "payload")]
    for name, point, box in bodies:
        if found := outside(point, getattr(params, f"{box}_low"), getattr(params, f"{box}_high")):
            return f"{name} {found}"
    return None


@dataclass(frozen=True)
class CheckParams:
    """Limits of the checks before arming; each catches a mistake that no single
    pose betrays.
    """

    tilt_deg: float  # of the vehicle: a wrong quaternion order stands it on its head
    # that the vehicle is put up with: 90 or 180 deg off, an axis or a quaternion is exchanged
    heading_deg: float
    heading_tolerance_deg: float
    # between payload and vehicle against the rope's length [m]: bodies exchanged, marker lost
    rope_tolerance: float
    home_radius: float  # of the vehicle from its hover point [m]
    speed: float  # of the vehicle, noise included [m/s]
    # body rates of a doublet in the first hover, by which signs are seen [rad/s]; 0: none
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
    """Return what speaks against a throw, in words; ``hang`` is what the payload hangs below the
    vehicle at rest [m].
    """
    failed = []
    if vehicle.quat is None:
        return ["the vehicle's source gives no attitude"]
    tilt, heading = map(math.degrees, tilt_and_heading(vehicle.quat))
    if tilt > params.tilt_deg:
        failed.append(f"vehicle tilted by {tilt:.0f} deg (quaternion order or body axes wrong?)")
    off = (heading - params.heading_deg + 180.0) % 360.0 - 180.0
    if abs(off) > params.heading_tolerance_deg:
        failed.append(
            f"heading {heading:.0f} deg, not {params.heading_deg:g} (axes, yaw offset or quaternion"
            " wrong?)"
        )
    below = math.dist(payload.pos, (vehicle.pos[0], vehicle.pos[1], vehicle.pos[2] - hang))
    if below > params.rope_tolerance:
        failed.append(
            f"payload {below:.2f} m from where it should hang (bodies exchanged, or an offset"
            " wrong?)"
        )
    distance = math.dist(vehicle.pos, home_w)
    if distance > params.home_radius:
        failed.append(f"vehicle {distance:.2f} m from its hover point")
    speed = math.hypot(*vehicle.vel)
    if speed > params.speed:
        failed.append(f"vehicle moves at {speed:.2f} m/s")
    if found := outside(goal_w, fence.payload_low, fence.payload_high):
        failed.append(f"goal {found}")
    if broken := fence_broken(fence, vehicle, payload):
        failed.append(broken)
    return failed
