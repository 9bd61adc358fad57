"""Where and how fast the payload must be let go: projectile motion, with height and speed taken from a learnt policy.

Source: the paper, Sec. IV-A: release height and speed are mirrored from the policy, the release state follows from the
drag-free flight to the target. The release is horizontal.
"""

from dataclasses import dataclass

import numpy as np

from sim.params import GRAVITY
from visthrow.common.errors import ConfigError
from visthrow.logs.flightlog import FlightLog

POLICY_RELEASES = {1.5: (1.107, 2.270), 2.0: (1.127, 2.935), 2.5: (1.146, 3.602)}
"""Target [m] -> height [m] and speed [m/s] at separation of the shipped state policy in the training simulator; mean of
five flights. :func:`measure` reads them off any policy."""


@dataclass(frozen=True)
class Release:
    """State at which the payload is let go, and what follows."""

    pos_w: np.ndarray  # [m], shape (3,)
    vel_w: np.ndarray  # [m/s], shape (3,)
    fall_time: float  # from release to landing [s]


def fall_time(pos_z: np.ndarray, vel_z: np.ndarray, landing_height: float) -> np.ndarray:
    """Time to landing [s] from a height [m] and an upward velocity [m/s]; NaN where the height is never passed."""
    inside = np.asarray(vel_z) ** 2 + 2.0 * GRAVITY * (np.asarray(pos_z) - landing_height)
    return (vel_z + np.sqrt(np.where(inside < 0.0, np.nan, inside))) / GRAVITY


def landing_point(pos_w: np.ndarray, vel_w: np.ndarray, landing_height: float) -> tuple[np.ndarray, np.ndarray]:
    """Landing points (..., 2) [m] and times (...) [s] of payloads let go at states, shape (..., 3) each."""
    time = fall_time(pos_w[..., 2], vel_w[..., 2], landing_height)
    return pos_w[..., :2] + time[..., None] * vel_w[..., :2], time


def release_for(target: float, height: float, speed: float, landing_height: float) -> Release:
    """Release state of a throw along x.

    Args:
        target: distance of the target from the origin [m].
        height: of the payload at release [m].
        speed: at release, horizontal [m/s].
        landing_height: of the payload's centre at impact [m].

    Raises:
        ConfigError: No throw: a height below the landing's, or no speed.
    """
    if not (height > landing_height and speed > 0.0):
        raise ConfigError(
            f"release at {height:g} m height with {speed:g} m/s; expected above the landing's {landing_height:g} m and above 0"
        )
    fall = float(fall_time(np.float64(height), np.float64(0.0), landing_height))
    return Release(np.array([target - speed * fall, 0.0, height]), np.array([speed, 0.0, 0.0]), fall)


def default_release(target: float) -> tuple[float, float]:
    """Height [m] and speed [m/s] of the shipped policy's release at a target [m], between the measured ones linear."""
    known = sorted(POLICY_RELEASES)
    return tuple(float(np.interp(target, known, [POLICY_RELEASES[x][i] for x in known])) for i in range(2))


def read_release(log: FlightLog) -> tuple[float, float]:
    """Height [m] and speed [m/s] of the payload at the separation that a flight log records.

    Raises:
        ConfigError: The flight has no separation.
    """
    when = log.meta.get("times", {}).get("separation")
    if when is None:
        raise ConfigError(f"this flight let nothing go: {log.meta.get('result', {}).get('failure')}; expected a throw")
    pos, vel = log["payload_pos_w"], log["payload_vel_w"]
    height = float(np.interp(when, pos.time, pos.values[:, 2]))
    parts = [np.interp(when, vel.time, vel.values[:, i]) for i in range(3)]
    return height, float(np.linalg.norm(parts))


def measure(loaded, target: float, throws: int = 5, seed: int = 0) -> tuple[float, float]:
    """Mean height [m] and speed [m/s] of a policy's releases in the training simulator.

    Args:
        loaded: policy and experiment, :class:`visthrow.throws.loading.Loaded`.
        target: [m] along x.
        throws: flown one by one.
        seed: of the first; the others follow.
    """
    from visthrow.throws.recorded import fly

    goal = np.array([target, 0.0, 0.0])
    seen = [read_release(fly(loaded, goal, "hybrid", seed + i)) for i in range(throws)]
    return tuple(float(x) for x in np.mean(seen, axis=0))
