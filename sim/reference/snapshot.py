"""Records that every plant returns: the state of its vehicles and their payloads' landings."""

from dataclasses import dataclass

from numpy import ndarray


@dataclass(frozen=True)
class Snapshot:
    """State of E plants at one time; world frame, quaternions xyzw.

    Positions are of the frame's origin, not of a shifted centre of mass.
    """

    time: float  # [s]
    pos_w: ndarray  # [m], shape (E, 3)
    quat_wb: ndarray  # shape (E, 4)
    vel_w: ndarray  # [m/s], shape (E, 3)
    rate_b: ndarray  # [rad/s], shape (E, 3)
    payload_pos_w: ndarray  # its centre [m], shape (E, 3); the landing point after landing
    payload_vel_w: ndarray  # [m/s], shape (E, 3)
    cable_points_w: ndarray  # joints of the rope, mount end first [m], shape (E, L + 1, 3)
    motor_speed: ndarray  # [rad/s], shape (E, 4)
    battery_voltage: ndarray  # [V], shape (E,)
    attached: ndarray  # shape (E,), bool
    latched: ndarray  # shape (E,), bool


@dataclass(frozen=True)
class PayloadLandings:
    """Landing points and times of the payloads, on the plant's clock; NaN before the event."""

    landed: ndarray  # shape (E,), bool
    point_w: ndarray  # of the payload's centre [m], shape (E, 3)
    time: ndarray  # [s], shape (E,)
    separation_time: ndarray  # [s], shape (E,)
