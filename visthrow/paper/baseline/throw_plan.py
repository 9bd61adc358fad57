"""Plan a throw: the release state of the payload, its path, and the controller's reference at the
control periods.

Source: the paper, Sec. IV-A. Release height and speed are those of a learnt policy; the release
position follows from drag-free flight to the target. The release is horizontal."""

from dataclasses import dataclass
from functools import lru_cache

import numpy as np
from numpy import ndarray

from visthrow.common.errors import ConfigError
from visthrow.common.free_fall import fall_time
from visthrow.logs.flightlog import FlightLog
from visthrow.paper.baseline.pendulum_model import Pendulum
from visthrow.paper.baseline.spline import PlanParams, Spline, flat_reference, optimise

START_HEIGHT = 0.95  # height of the payload in hover (the paper, Sec. IV-A) [m]

POLICY_RELEASES = {1.5: (1.107, 2.270), 2.0: (1.127, 2.935), 2.5: (1.146, 3.602)}
"""Target [m] -> height [m] and speed [m/s] at separation of the shipped state policy in the
training simulator, means of five flights. :func:`measure` measures them for any policy.
"""


@dataclass(frozen=True)
class ReleaseState:
    """The payload's state at the release, and its flight afterwards."""

    pos_w: ndarray  # [m], shape (3,)
    vel_w: ndarray  # [m/s], shape (3,)
    fall_time: float  # time from release to landing [s]
    landing_height: float  # of the payload's centre [m]


def landing_point(pos_w: ndarray, vel_w: ndarray, landing_height: float) -> tuple[ndarray, ndarray]:
    """Return landing points (..., 2) [m] and flight times (...) [s] of payloads released at
    positions and velocities, shape (..., 3) each; NaN if the landing height is never reached.
    """
    with np.errstate(invalid="ignore"):
        time = fall_time(pos_w[..., 2] - landing_height, vel_w[..., 2], floor=-np.inf)
    return pos_w[..., :2] + time[..., None] * vel_w[..., :2], time


def release_for(target: float, height: float, speed: float, landing_height: float) -> ReleaseState:
    """Return the release state of a throw along x at a target [m], at a height [m] with a
    horizontal speed [m/s]; ``landing_height``: of the payload's centre [m].

    Raises ConfigError: the height is not above the landing height, or the speed is not positive.
    """
    if not (height > landing_height and speed > 0.0):
        raise ConfigError(
            f"release at {height:g} m height with {speed:g} m/s; expected a height above that of"
            f" the landing, {landing_height:g} m, and a positive speed"
        )
    fall = float(fall_time(np.float64(height - landing_height), np.float64(0.0)))
    pos_w = np.array([target - speed * fall, 0.0, height])
    return ReleaseState(pos_w, np.array([speed, 0.0, 0.0]), fall, landing_height)


def default_release(target: float) -> tuple[float, float]:
    """Return height [m] and speed [m/s] of the shipped policy's release at a target [m],
    interpolated linearly between measured ones.
    """
    names = sorted(POLICY_RELEASES)
    return tuple(
        float(np.interp(target, names, [POLICY_RELEASES[x][i] for x in names])) for i in range(2)
    )


def read_release(log: FlightLog) -> tuple[float, float]:
    """Return height [m] and speed [m/s] of the payload at separation in a flight log.

    Raises ConfigError: the log has no separation.
    """
    when = log.meta.get("times", {}).get("separation")
    if when is None:
        raise ConfigError(
            f"this flight released no payload: {log.meta.get('result', {}).get('failure')};"
            " expected a throw"
        )
    return float(log["payload_pos_w"].at(when)[2]), float(
        np.linalg.norm(log["payload_vel_w"].at(when))
    )


def measure(loaded, target: float, throws: int = 5, seed: int = 0) -> tuple[float, float]:
    """Return mean height [m] and speed [m/s] of a policy's releases at a target [m], over
    ``throws`` throws in the training simulator with successive seeds.
    """
    from visthrow.throws.recorded import fly

    goal = np.array([target, 0.0, 0.0])
    releases = [read_release(fly(loaded, goal, "hybrid", seed + i)) for i in range(throws)]
    return tuple(float(x) for x in np.mean(releases, axis=0))


@dataclass(frozen=True)
class ThrowPlan:
    """A planned throw."""

    model: Pendulum
    target: float  # [m] along x
    release: ReleaseState
    path: Spline

    @property
    def duration(self) -> float:
        """Return the planned time from start to landing [s]."""
        return self.path.duration + self.release.fall_time

    def reference(self, begin: float, period: float, count: int) -> tuple[ndarray, ndarray]:
        """Return states (count + 1, 16) at ``begin`` [s] and after each period, and inputs
        (count, 4) in the middle of the periods.
        """
        ends = begin + period * np.arange(count + 1)
        states = flat_reference(self.model, self.path.sample(ends))[0]
        inputs = flat_reference(self.model, self.path.sample(ends[:-1] + 0.5 * period))[1]
        return states, inputs


@lru_cache(maxsize=64)
def plan_throw(
    model: Pendulum,
    target: float,
    height: float,
    speed: float,
    params: PlanParams,
    landing_height: float,
    period: float = 0.02,
    lag: float = 0.0,
) -> ThrowPlan:
    """Plan a throw along x from hover at the origin; first arguments: see :func:`release_for`.

    The release is at a whole number of the controller's periods [s] plus the lag [s] from latch to
    separation."""
    release = release_for(target, height, speed, landing_height)
    start = np.array([0.0, 0.0, START_HEIGHT])
    path = optimise(model, start, release.pos_w, release.vel_w, params, (period, lag % period))
    return ThrowPlan(model, target, release, path)
