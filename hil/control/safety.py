"""What stands between a decision and the vehicle: output guard, geofences, checks before flight."""

import math
from dataclasses import dataclass

from hil.poses.pose import Vector
from hil.poses.track import BodyState
from visthrow.common.rotations import tilt_and_heading


@dataclass(frozen=True)
class GuardParams:
    """Limits on the change of a command from one tick to the next. Its bounds are those of the policy's training.

    Raises:
        ValueError: a limit of 0 or less.
    """

    slew_thrust: float  # [N]
    slew_rate: tuple[float, float, float]  # [rad/s]

    def __post_init__(self) -> None:
        if min(self.slew_thrust, *self.slew_rate) <= 0.0:
            raise ValueError(f"slew_thrust is {self.slew_thrust}, slew_rate {self.slew_rate}; expected limits above 0")


class Guard:
    """Clips and slew-limits commands, and refuses those that are not finite.

    Attributes:
        clipped, slewed, refused: number of commands that were changed, or not let through.
    """

    def __init__(self, params: GuardParams, max_thrust: float, max_rate: Vector) -> None:
        """Take the limits: collective thrust within 0 and ``max_thrust`` [N], body rates within ``max_rate`` [rad/s]."""
        self._low, self._high = (0.0, *(-r for r in max_rate)), (max_thrust, *max_rate)
        self._slew = (params.slew_thrust, *params.slew_rate)
        self._last: tuple[float, ...] | None = None
        self.clipped = self.slewed = self.refused = 0

    def reset(self) -> None:
        """Forget the last command: after a silence nothing is known of what the vehicle does."""
        self._last = None

    def check(self, command: tuple[float, ...]) -> tuple[float, ...] | None:
        """The command that may be sent, [N, rad/s], or None where it is not finite."""
        if len(command) != 4 or not all(map(math.isfinite, command)):
            self.refused += 1
            return None
        bounded = tuple(min(max(c, low), high) for c, low, high in zip(command, self._low, self._high))
        self.clipped += bounded != command
        if self._last is not None:
            slow = tuple(min(max(c, last - s), last + s) for c, last, s in zip(bounded, self._last, self._slew))
            self.slewed += slow != bounded
            bounded = slow
        self._last = bounded
        return bounded


@dataclass(frozen=True)
class FenceParams:
    """Boxes in our world that vehicle and payload may not leave, and the goal may not lie outside of.

    Raises:
        ValueError: a box whose corners are not ascending, or a deceleration of 0 or less.
    """

    vehicle_low: tuple[float, float, float]  # [m]
    vehicle_high: tuple[float, float, float]  # [m]
    payload_low: tuple[float, float, float]  # [m]
    payload_high: tuple[float, float, float]  # [m]
    deceleration: float  # that the vehicle brakes with [m/s^2]

    def __post_init__(self) -> None:
        for body, lowest, highest in (("vehicle", self.vehicle_low, self.vehicle_high), ("payload", self.payload_low, self.payload_high)):
            if any(low >= high for low, high in zip(lowest, highest)):
                raise ValueError(f"{body}_low is {lowest} m, {body}_high {highest} m; expected ascending corners")
        if not self.deceleration > 0.0:
            raise ValueError(f"deceleration is {self.deceleration} m/s^2; expected a number above 0")


def braking_point(state: BodyState, deceleration: float) -> Vector:
    """Where a body comes to rest that brakes along each axis, ``x + v |v| / (2 a)`` [m], world frame."""
    return tuple(x + v * abs(v) / (2.0 * deceleration) for x, v in zip(state.pos, state.vel))


def outside(point: Vector, low: Vector, high: Vector) -> str | None:
    """The first axis along which a point lies outside of a box, with its value; None inside."""
    for axis, x, least, most in zip("xyz", point, low, high):
        if not least <= x <= most:
            return f"{axis} {x:.2f} m beyond {least:g} to {most:g} m"
    return None


def fence_broken(params: FenceParams, vehicle: BodyState, payload: BodyState | None) -> str | None:
    """Which fence is broken, or will be at the end of braking; None where all is well.

    Args:
        params: the fences.
        vehicle: its state.
        payload: its state while it hangs; None when it flies freely, which nothing can brake.
    """
    stop = braking_point(vehicle, params.deceleration)
    for name, point in (("vehicle", vehicle.pos), ("vehicle's braking point", stop)):
        found = outside(point, params.vehicle_low, params.vehicle_high)
        if found:
            return f"{name} {found}"
    if payload is not None:
        found = outside(payload.pos, params.payload_low, params.payload_high)
        if found:
            return f"payload {found}"
    return None


@dataclass(frozen=True)
class CheckParams:
    """What must hold before the runner lets itself be armed; each catches a mistake that no single pose betrays."""

    tilt_deg: float  # of the vehicle: a wrong quaternion order stands it on its head
    heading_deg: float  # that the vehicle is put up with: 90 or 180 deg off, an axis or a quaternion is exchanged
    heading_tolerance_deg: float
    rope_tolerance: float  # between payload and vehicle against the rope's length [m]: bodies exchanged, marker lost
    home_radius: float  # of the vehicle from its hover point [m]
    speed: float  # of the vehicle, noise included [m/s]


def failed_checks(
    params: CheckParams, fence: FenceParams, vehicle: BodyState, payload: BodyState, goal_w: Vector, home_w: Vector,
    hang: float,
) -> list[str]:  # fmt: skip
    """What speaks against a throw, in words; empty where nothing does.

    Args:
        params: limits. fence: for goal and bodies.
        vehicle, payload: states.
        goal_w: [m]. home_w: where the vehicle hovers [m].
        hang: of the payload's centre below the vehicle's at rest [m].
    """
    failed = []
    if vehicle.quat is None:
        return ["the vehicle's source gives no attitude"]
    tilt, heading = map(math.degrees, tilt_and_heading(vehicle.quat))
    if tilt > params.tilt_deg:
        failed.append(f"vehicle tilted by {tilt:.0f} deg (quaternion order or body axes wrong?)")
    off = (heading - params.heading_deg + 180.0) % 360.0 - 180.0
    if abs(off) > params.heading_tolerance_deg:
        failed.append(f"heading {heading:.0f} deg, not {params.heading_deg:g} (axes, yaw offset or quaternion wrong?)")
    below = math.dist(payload.pos, (vehicle.pos[0], vehicle.pos[1], vehicle.pos[2] - hang))
    if below > params.rope_tolerance:
        failed.append(f"payload {below:.2f} m from where it should hang (bodies exchanged, or an offset wrong?)")
    away = math.dist(vehicle.pos, home_w)
    if away > params.home_radius:
        failed.append(f"vehicle {away:.2f} m from its hover point")
    speed = math.hypot(*vehicle.vel)
    if speed > params.speed:
        failed.append(f"vehicle moves at {speed:.2f} m/s")
    found = outside(goal_w, fence.payload_low, fence.payload_high)
    if found:
        failed.append(f"goal {found}")
    broken = fence_broken(fence, vehicle, payload)
    if broken:
        failed.append(broken)
    return failed
