"""A ball in free flight under motion capture: drag, spin, wind, and errors of the capture's frame,
clock and scale.

The log holds no mass, and a path determines only accelerations: forces are per kilogram.
"""

from dataclasses import dataclass

import numpy as np
from numpy import ndarray
from scipy.interpolate import CubicHermiteSpline

from visthrow.common.rotations import cross
from visthrow.config.bounds import Bounded, NotNegative, Positive
from visthrow.diagnose.models.numeric import (
    Lanes,
    NumericModel,
    Stretch,
    halves,
    integrate,
    sigma_of,
)
from visthrow.logs.flightlog import FlightLog
from visthrow.logs.samples import Samples

CHANNEL = "payload_pos_w"
# integration steps of a free flight: about 10 ms each, at which the path is accurate to 1 um
STEPS = 80
FALLS = 0.7
"""Acceleration minus gravity's, relative to gravity, below which a ball is in flight: fast,
spinning balls have that much drag and lift; a ball at rest has 1.
"""


@dataclass(frozen=True)
class BallParams(Bounded):
    """The ball before any effect is found."""

    gravity: Positive  # [m/s^2]
    drag: NotNegative  # k / m of the quadratic drag k |v| v [1/m]
    edge: NotNegative  # time cut off at either end of a free flight [s]
    shortest: Positive  # shortest free flight to use [s]
    every: int = 1  # use every n-th sample


class BallModel(NumericModel):
    """Free flights of a ball, one window each."""

    table = "ball"
    pushes = ((2, 0), (2, 1), (2, 2))
    knot_count = 9
    channels = needed = (CHANNEL,)

    def windows_of(self, log: FlightLog, number: int) -> list[Stretch]:
        """See the base class."""
        params = self.params
        times, path = log[CHANNEL].samples()
        if len(times) < 40:
            return []
        sigma = sigma_of(log[CHANNEL], 1e-5)
        flights = []
        for start, end in _free(times, path, params):
            rows = np.flatnonzero((times >= start) & (times <= end))[:: params.every]
            time = times[rows]
            pos = path[rows]
            fit = np.polynomial.polynomial.polyfit(time - time[0], pos, 3)
            vel_x, vel_y, _ = fit[1]
            sideways = np.array([-vel_y, vel_x, 0.0])
            sideways /= max(np.linalg.norm(sideways), 1e-6)
            data = {"time": time, "across": sideways, "span": np.ptp(time)}
            begin = [*fit[0], *fit[1]], [0.1, 0.1, 0.1, 1.0, 1.0, 1.0]
            table = time, pos, sigma
            span = time[0], time[-1]
            flights.append(self.lay_out(number, "ballistic", [table], span, data, *begin))
        return flights

    def simulate(self, lanes: Lanes) -> ndarray:
        """See the base class; returns position and velocity on the grid.

        The initial state is position and velocity at the first stamp.
        """
        drag, linear, top, side, wind_x, wind_y, _, _, clock, _ = lanes.theta.T
        wind = np.stack([wind_x, wind_y, 0.0 * wind_x], 1)
        sideways = self.of_windows(lanes, "across")
        upright = np.array([0.0, 0.0, 1.0])
        spin = top[:, None] * sideways + side[:, None] * upright
        push = self.pushes_at(lanes, halves(STEPS))
        gravity = np.array([0.0, 0.0, -self.params.gravity])
        quadratic = (self.params.drag + drag)[:, None]
        linear = linear[:, None]

        def slope(index: int, state: ndarray) -> ndarray:
            vel = state[:, 3:]
            air = vel - wind
            speed = np.sqrt(np.sum(air * air, 1, keepdims=True))
            acc = gravity - (quadratic * speed + linear) * air + cross(spin, air) + push[index]
            return np.concatenate([vel, acc + self.exert("payload force", state)], 1)

        step = self.of_windows(lanes, "span")[:, None] / STEPS * (1.0 + clock[:, None])
        return integrate(slope, lanes.nuisance, STEPS, step)

    def quantities(self, time: ndarray, state: ndarray) -> dict[str, ndarray]:
        """See the base class; a law's coefficient is that of a ball of 1 kg."""
        return {"time": time, "payload_pos_w": state[:, :3], "payload_vel_w": state[:, 3:]}

    def measure(self, stretch: Stretch, path: ndarray, lanes: Lanes) -> ndarray:
        """See the base class."""
        tilt_x, tilt_y, clock, scale = lanes.theta.T[6:]
        time = stretch.data["time"]
        grid = np.linspace(time[0], time[-1], STEPS + 1)
        rate = path[..., 3:] * (1.0 + clock[:, None, None])
        pos = CubicHermiteSpline(grid, path[..., :3], rate, axis=1)(time)
        first = pos[:, :1]
        displacement = pos - first
        tilt = np.stack([tilt_x, tilt_y, 0.0 * tilt_x], 1)
        displacement = displacement + cross(tilt[:, None], displacement)
        return (first + displacement * (1.0 + scale)[:, None, None]).reshape(len(path), -1)


def _free(time: ndarray, pos: ndarray, params: BallParams) -> list[tuple[float, float]]:
    """Return the first and last time of each free flight [s], without ``edge`` at either end.

    A ball is in flight where its acceleration, from two derivatives over 50 ms, is gravity's but
    for ``FALLS`` of it.
    """
    vel = Samples(time, pos).derivative(0.05)
    if len(vel.time) < 20:
        return []
    stamps, acc = vel.derivative(0.05)
    off = np.linalg.norm(acc + np.array([0.0, 0.0, params.gravity]), axis=1)
    falls = np.pad((off < FALLS * params.gravity).astype(int), 1)
    edges = np.flatnonzero(np.diff(falls))
    spans = []
    for first, stop in edges.reshape(-1, 2):
        start = stamps[first] + params.edge
        end = stamps[stop - 1] - params.edge
        if end - start >= params.shortest:
            spans.append((start, end))
    return spans
