"""The hover controller: collective thrust and body rates that hold a position and a heading.

Onboard-safe (numpy only). It flies before a throw, with the payload, and after the release, without
it; the policy does neither. It is batched over vehicles; on board the batch is one."""

from dataclasses import dataclass
from typing import Annotated

import numpy as np
from numpy import ndarray
from numpy.linalg import norm

from camera.field_bounds import Bound, BoundedFields, NotNegative, NotNegativeVector
from visthrow.common.free_fall import GRAVITY
from visthrow.common.rotations import matrix_of_quat


@dataclass(frozen=True)
class HoverParams(BoundedFields):
    """Gains and limits, chosen on the full simulator of the paper's vehicle.

    The swing of a 0.33 m rope under this vehicle (5.9 rad/s with the vehicle free to move) is
    faster than the position loop, which damps it because the vehicle yields to the rope's pull. A
    higher ``attitude_gain`` or ``velocity_gain`` damps it faster but reduces the stability margin:
    from 12 and 3.5 on, 20 ms of additional delay make the vehicle without payload ring; at 18 it
    oscillates at the nominal delay. With the default gains the swing halves every 1.4 s.

    Raises ValueError: a gain or limit is negative, or the thrust limits are not ordered.
    """

    position_gain: NotNegative = 1.5  # commanded velocity per position error [1/s]
    velocity_gain: NotNegative = 3.5  # [1/s]
    integral_gain: NotNegative = 3.0  # [1/s^3]
    integral_limit: NotNegative = 1.5  # of each component [m/s^2]
    integral_radius: NotNegative = 0.3  # distance from the goal within which the integral grows [m]
    max_speed: NotNegative = 1.5  # of the commanded velocity [m/s]
    max_acceleration: NotNegative = 6.0  # vertical, commanded in addition to gravity [m/s^2]
    max_tilt: Annotated[float, Bound(0.0, np.pi / 2, "[)")] = 0.6  # of the commanded thrust [rad]
    attitude_gain: NotNegative = 9.0  # [1/s]
    yaw_gain: NotNegative = 2.0  # [1/s]
    max_rate: NotNegativeVector = (8.0, 8.0, 2.0)  # [rad/s]
    min_thrust: NotNegative = 0.2  # [N]
    max_thrust: NotNegative = 14.0  # [N]

    def __post_init__(self) -> None:
        super().__post_init__()
        if not self.min_thrust < self.max_thrust:
            raise ValueError(
                f"min_thrust {self.min_thrust} N is not below max_thrust {self.max_thrust} N"
            )


class HoverController:
    """A position controller with an integral for each of E vehicles."""

    def __init__(self, params: HoverParams, period: float, count: int = 1):
        """Start with integrals of zero for ``count`` vehicles; ``period``: time between calls [s].

        Raises `ValueError`: either is not positive.
        """
        if not (period > 0.0 and count >= 1):
            raise ValueError(f"period {period} s and count {count}; expected both above 0")
        self.params = params
        self.period = period
        self._integral_w = np.zeros((count, 3))

    def reset(self, mask: ndarray | None = None) -> None:
        """Set the integrals to zero for the vehicles in ``mask``, shape (E,); default all."""
        self._integral_w[slice(None) if mask is None else np.asarray(mask, dtype=bool)] = 0.0

    def step(
        self,
        pos_w: ndarray,
        quat_wb: ndarray,
        vel_w: ndarray,
        goal_w: ndarray,
        mass: float | ndarray,
        yaw: float | ndarray = 0.0,
    ) -> ndarray:
        """Return the command that brings the vehicles to their goals.

        Args:
            pos_w: Positions [m], shape (E, 3), world frame.
            quat_wb: Attitudes, xyzw, shape (E, 4).
            vel_w: Velocities [m/s], shape (E, 3), world frame.
            goal_w: Positions to hold [m], shape (E, 3) or (3,), world frame.
            mass: Total mass with the load [kg], scalar or shape (E,).
            yaw: Headings to hold [rad], scalar or shape (E,).

        Returns:
            Collective thrust along body z [N] and body rates [rad/s], shape (E, 4).
        """
        params = self.params
        rot_wb = matrix_of_quat(np.asarray(quat_wb, dtype=float))
        thrust_w = self._acceleration(pos_w, vel_w, goal_w)
        thrust_w[:, 2] += GRAVITY
        thrust_w = _limit_tilt(thrust_w, params.max_tilt)
        # Projected on the present thrust axis: while the vehicle still rotates, no thrust is added
        # in a wrong direction.
        thrust = np.asarray(mass) * np.sum(thrust_w * rot_wb[:, :, 2], axis=1)
        rates_b = _rates(rot_wb, thrust_w, np.asarray(yaw, dtype=float), params)
        command = np.empty((len(rates_b), 4))
        command[:, 0] = np.clip(thrust, params.min_thrust, params.max_thrust)
        command[:, 1:] = np.clip(rates_b, np.negative(params.max_rate), params.max_rate)
        return command

    def _acceleration(self, pos_w: ndarray, vel_w: ndarray, goal_w: ndarray) -> ndarray:
        params = self.params
        error_w = np.asarray(goal_w, dtype=float) - pos_w
        asked_w = params.position_gain * error_w
        speed = norm(asked_w, axis=1, keepdims=True)
        fast = speed > params.max_speed
        asked_w *= np.where(fast, params.max_speed / np.maximum(speed, 1e-9), 1.0)
        # During a long approach an integral would wind up and cause an overshoot.
        close = norm(error_w, axis=1, keepdims=True) < params.integral_radius
        growth_w = np.where(close, params.integral_gain * self.period * error_w, 0.0)
        self._integral_w = np.clip(
            self._integral_w + growth_w, -params.integral_limit, params.integral_limit
        )
        acceleration_w = params.velocity_gain * (asked_w - vel_w) + self._integral_w
        acceleration_w[:, 2] = np.clip(
            acceleration_w[:, 2], -params.max_acceleration, params.max_acceleration
        )
        return acceleration_w


def _limit_tilt(thrust_w: ndarray, max_tilt: float) -> ndarray:
    """Reduce the horizontal part of the thrust (E, 3) so that its tilt from the vertical is at most
    ``max_tilt`` [rad].
    """
    up = np.maximum(thrust_w[:, 2], 0.1 * GRAVITY)  # never fly inverted to descend
    flat = norm(thrust_w[:, :2], axis=1)
    scale = np.minimum(1.0, np.tan(max_tilt) * up / np.maximum(flat, 1e-9))
    return np.column_stack((thrust_w[:, :2] * scale[:, None], up))


def _rates(rot_wb: ndarray, thrust_w: ndarray, yaw: ndarray, params: HoverParams) -> ndarray:
    """Return body rates (E, 3) [rad/s] that rotate body z to the thrust's direction by the shortest
    rotation, and the heading to yaw.
    """
    aim_b = np.einsum("eji,ej->ei", rot_wb, thrust_w / norm(thrust_w, axis=1, keepdims=True))
    sine = norm(aim_b[:, :2], axis=1)
    angle = np.arctan2(sine, aim_b[:, 2])
    # e_z x aim = (-aim_y, aim_x, 0); exactly inverted, any axis is valid.
    axis = np.where(sine[:, None] > 1e-9, np.column_stack((-aim_b[:, 1], aim_b[:, 0])), (1.0, 0.0))
    divisor = np.where(sine > 1e-9, sine, 1.0)
    tilt_rates = params.attitude_gain * angle[:, None] * axis / divisor[:, None]
    heading = np.arctan2(rot_wb[:, 1, 0], rot_wb[:, 0, 0])
    error = np.angle(np.exp(1j * (yaw - heading)))
    # This is body z's share of a rotation about the world's vertical; zero for a vehicle on its
    # side.
    return np.column_stack((tilt_rates, params.yaw_gain * error * rot_wb[:, 2, 2]))
