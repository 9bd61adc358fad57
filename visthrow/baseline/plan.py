"""A planned throw: release state, payload's path, and the reference of the controller on its grid of periods."""

from dataclasses import dataclass

import numpy as np

from visthrow.baseline.pendulum import Pendulum
from visthrow.baseline.release import Release, release_for
from visthrow.baseline.spline import PlanParams, Spline, flat_reference, optimise

START_HEIGHT = 0.95
"""Height of the payload in hover (the paper, Sec. IV-A) [m]."""


@dataclass(frozen=True)
class Plan:
    """One planned throw."""

    model: Pendulum
    target: float  # [m] along x
    release: Release
    path: Spline
    params: PlanParams

    @property
    def duration(self) -> float:
        """From start to landing, if all goes as planned [s]."""
        return self.path.duration + self.release.fall_time

    def reference(self, begin: float, period: float, count: int) -> tuple[np.ndarray, np.ndarray]:
        """States (count + 1, 16) at ``begin`` [s] and each period on; inputs (count, 4) in the middle of the periods."""
        ends = begin + period * np.arange(count + 1)
        states = flat_reference(self.model, self.path.sample(ends))[0]
        inputs = flat_reference(self.model, self.path.sample(ends[:-1] + 0.5 * period))[1]
        return states, inputs


def plan_throw(
    model: Pendulum,
    target: float,
    height: float,
    speed: float,
    params: PlanParams,
    landing_height: float,
    period: float = 0.02,
    lag: float = 0.0,
) -> Plan:
    """Plan a throw along x from hover at the origin.

    Args:
        model: masses and length.
        target: [m].
        height: of the payload at release [m]. speed: at release [m/s].
        params: weights and bounds of the path.
        landing_height: of the payload's centre at impact [m].
        period: of the controller [s]; the release falls on a whole number of periods and
        lag: from the latch to separation that is made up for [s].
    """
    release = release_for(target, height, speed, landing_height)
    start = np.array([0.0, 0.0, START_HEIGHT])
    path = optimise(model, start, release.pos_w, release.vel_w, params, (period, lag % period))
    return Plan(model, target, release, path, params)
