"""Plan the payload's path from hover to release: a septic spline with jointly optimised waypoints
and segment times; compute states and inputs by differential flatness.

Derivatives up to the fifth are continuous between segments of degree 7, so that the body rates of
the flat vehicle are continuous. The path starts at rest with the vehicle level (all derivatives 0).
It ends with the release's velocity and without acceleration or higher derivatives. After its end it
continues at constant velocity, as a reference for a controller whose horizon extends beyond the
release. With four segments the waypoints determine all coefficients.

The optimisation over waypoints and times minimises ``rho int |snap|^2 dt + w_t T`` plus penalties
on speed, acceleration and workspace (the paper, Sec. IV-A; bounds and weights of penalties are
ours). Two further penalties are ours, on the thrust vector and its rotation: without them short
plans flip the vehicle in ways that no quadrotor can follow."""

import math
from collections.abc import Callable
from dataclasses import dataclass
from functools import lru_cache

import numpy as np
from numpy import ndarray
from scipy.interpolate import PPoly
from scipy.optimize import least_squares
from scipy.special import perm

from sim.params import GRAVITY
from visthrow.common.errors import VisthrowError
from visthrow.paper.baseline.pendulum_model import INPUTS, STATES, Pendulum

SEGMENTS = 4
ORDER = 8
SMOOTH = 6  # derivatives 0 to 5 are continuous between segments, and fixed at the start

PLANE = [0, 2]  # axes of the throw: forward and up
UP = np.array([0.0, GRAVITY])  # acceleration against gravity, in the plane [m/s^2]

END = 5  # derivatives 0 to 4 are fixed at the release

SAMPLES = 30
"""Samples of a segment, for penalties and energy, during the optimisation of a path."""
DENSE = 300
"""Samples of a segment for the final value of a path, as thrust has narrow peaks."""


class PlanError(VisthrowError):
    """Planning a trajectory failed."""


LONGEST = (2.4, 1.8, 1.4, 1.1, 0.9)
SHORTEST = 0.4
COARSE = 0.1
"""Durations of the coarse search: several first ones, the shortest, the step [s].

The best result is used.
"""

EVEN = 0.02
"""Weight of the squared logarithm of the ratio of a segment's time to that of the first one,
relative to the weight of the duration [s]; without it the segments become so unequal that the path
oscillates.
"""

MOST_UNEVEN = float(np.log(2.0))
"""Size of this logarithm above which the penalty acts; a segment of a few milliseconds would be
missed by the samples.
"""

# factor on the missing vertical thrust [1/N]; below zero the vehicle inverts and the path is
# useless
STIFF = 6.0

DIFFERENCE = 1e-6  # finite-difference step, in m and in logarithms of time

# evaluations of the objective at each duration, starting from the previous duration's path
EVALUATIONS = 100

STOP_RATIO = 2.0  # ratio of the objective to the best one at which the search stops


@dataclass(frozen=True)
class PlanParams:
    """Weights and soft bounds; ``duration`` and ``energy`` are those of the paper's table, the
    others are ours.
    """

    duration: float = 30e3  # w_t [1/s]
    energy: float = 0.005  # rho [s^7/m^2]
    max_speed: float = 4.5  # of the payload [m/s]
    max_acceleration: float = 12.0  # of the payload [m/s^2]
    floor: float = 0.5  # lowest height of the payload [m]
    ceiling: float = 2.2  # highest height of the payload [m]
    backward: float = 0.4  # largest distance of the payload behind the start [m]
    max_thrust: float = 12.0  # of the vehicle [N]
    least_lift: float = 0.8  # lowest vertical thrust [N]
    least_pull: float = 0.4  # lowest vertical force of the cable, in weights of the payload [-]
    max_turn: float = 9.0  # rotation rate of the thrust's direction [rad/s]
    # weight of the squared excess, integrated over time [1/s]; the excess is relative to the bound,
    # or in m or weights
    penalty: float = 1e5


@dataclass(frozen=True)
class Spline:
    """A piecewise polynomial of the payload's position, constant before its start and with constant
    velocity after its end.
    """

    times: ndarray  # durations of the segments [s], shape (S,)
    coefficients: ndarray  # of t^0 to t^7, t from the segment's start, shape (S, 8, 3)

    @property
    def duration(self) -> float:
        """Return the time from start to release [s]."""
        return float(self.times.sum())

    def sample(self, time: ndarray, derivatives: int = 6) -> ndarray:
        """Return the payload's position and derivatives [m/s^n] at times since the start [s], shape
        (T,), as an array of shape (T, derivatives, 3); two derivatives or more.
        """
        time = np.atleast_1d(np.asarray(time, dtype=float))
        clipped = np.clip(time, 0.0, self.duration)
        breaks = np.append(0.0, np.cumsum(self.times))
        pieces = PPoly(self.coefficients[:, ::-1].swapaxes(0, 1), breaks)
        out = np.stack([pieces(clipped, n) for n in range(derivatives)], axis=1)
        past = (time - clipped)[:, None]
        out[:, 0] += past * out[:, 1]
        out[:, 2:][past[:, 0] > 0.0] = 0.0
        return out


def _rows(time: ndarray, derivatives: int = SMOOTH) -> ndarray:
    """Return the derivatives of the monomials t^0 to t^7 at times, shape (T, derivatives, 8)."""
    n = np.arange(derivatives)[:, None]
    k = np.arange(ORDER)
    return perm(k, n) * (time[:, None] ** k)[:, np.maximum(k - n, 0)]


# these rows at a segment's start and at its end, in units of its time
BEGINS, ENDS = _rows(np.array([0.0, 1.0]))


@lru_cache(maxsize=4)
def _sample_rows(samples: int) -> ndarray:
    return _rows((np.arange(samples) + 0.5) / samples)


def _coefficients(
    start: ndarray,
    waypoints: ndarray,
    end: ndarray,
    velocity: ndarray,
    times: ndarray,
) -> ndarray:
    """Return the coefficients of B paths in units of each segment's time, which keeps the matrix
    well conditioned.

    Waypoints (B, 3, D), times (B, 4); returns (B, 4, 8, D).
    """
    size = SEGMENTS * ORDER
    count = len(times)
    matrix = np.zeros((count, size, size))
    right = np.zeros((count, size, len(start)))
    matrix[:, :SMOOTH, :ORDER] = BEGINS
    right[:, 0] = start
    row = SMOOTH
    for i in range(SEGMENTS - 1):
        before = slice(i * ORDER, (i + 1) * ORDER)
        after = slice((i + 1) * ORDER, (i + 2) * ORDER)
        matrix[:, row, before] = ENDS[0]
        right[:, row] = waypoints[:, i]
        matrix[:, row + 1 : row + 1 + SMOOTH, before] = ENDS
        ratio = (times[:, i] / times[:, i + 1])[:, None] ** np.arange(SMOOTH)
        matrix[:, row + 1 : row + 1 + SMOOTH, after] = -ratio[:, :, None] * BEGINS
        row += 1 + SMOOTH
    matrix[:, row:, -ORDER:] = ENDS[:END]
    right[:, row] = end
    right[:, row + 1] = velocity * times[:, -1:]
    return np.linalg.solve(matrix, right).reshape(count, SEGMENTS, ORDER, -1)


def residuals(
    unit: ndarray, times: ndarray, params: PlanParams, model: Pendulum, samples: int = SAMPLES
) -> dict[str, ndarray]:
    """Return the residuals of the objective for B planar paths (along the throw, up).

    Args:
        unit: coefficients in units of each segment's time, shape (B, 4, 8, 2).
        times: durations of the segments [s], shape (B, 4).
        params: weights and bounds. model: the pendulum.
        samples: number of samples of each segment.

    Returns:
        ``duration``, ``energy``, ``penalty``: arrays (B, ...) whose sums of squares are the parts
        of the objective.
    """
    count = len(times)
    path = np.einsum("tdk,bskc->dbstc", _sample_rows(samples), unit)
    path /= (times[None] ** np.arange(SMOOTH)[:, None, None])[:, :, :, None, None]
    path = path.reshape(SMOOTH, -1, 2)
    weight = np.sqrt(np.repeat(times / samples, samples, axis=1)).reshape(-1)
    force, change = _thrust(model, path)[:2]
    size = np.linalg.norm(force, axis=1)
    turn = np.abs(_turn(force, change)) / np.maximum(size, 0.05) ** 2
    begin = np.repeat(unit[:, 0, 0, 0], SEGMENTS * samples)
    excess = np.array(
        [
            np.linalg.norm(path[1], axis=1) / params.max_speed - 1.0,
            np.linalg.norm(path[2], axis=1) / params.max_acceleration - 1.0,
            path[0, :, 1] - params.ceiling,
            params.floor - path[0, :, 1],
            begin - path[0, :, 0] - params.backward,
            size / params.max_thrust - 1.0,
            STIFF * (params.least_lift - force[:, 1]),
            (params.least_pull - 1.0 - path[2, :, 1] / GRAVITY),
            np.minimum(turn / params.max_turn - 1.0, 20.0),
        ]
    )
    penalty = np.sqrt(params.penalty) * weight * np.maximum(excess, 0.0)
    return {
        "duration": np.sqrt(params.duration * times.sum(1, keepdims=True)),
        "energy": (np.sqrt(params.energy) * weight[:, None] * path[4]).reshape(count, -1),
        "penalty": penalty.reshape(len(excess), count, -1).transpose(1, 0, 2).reshape(count, -1),
    }


def optimise(
    model: Pendulum,
    start_w: ndarray,
    end_w: ndarray,
    velocity_w: ndarray,
    params: PlanParams,
    tick: tuple[float, float] = (0.02, 0.0),
) -> Spline:
    """Plan the payload's path from hover to the release, in the plane of x and z.

    Raises PlanError: the optimisation does not find a path.

    Args:
        model: the pendulum. params: weights and bounds.
        start_w, end_w: [m], shape (3,). velocity_w: velocity at the release [m/s], shape (3,).
        tick: period and offset [s]: the duration is the offset plus a whole number of periods, so
            that a controller with this period can release at the end.
    """
    begin, end, velocity = (vector[PLANE] for vector in (start_w, end_w, velocity_w))

    def build(x: ndarray, total: float) -> tuple[ndarray, ndarray]:
        ratio = np.exp(np.concatenate([np.zeros((len(x), 1)), x[:, -(SEGMENTS - 1) :]], axis=1))
        middle = _base(begin, end, velocity, total) + x[:, : -(SEGMENTS - 1)].reshape(len(x), -1, 2)
        times = total * ratio / ratio.sum(1, keepdims=True)
        return _coefficients(begin, middle, end, velocity, times), times

    def objective(x: ndarray, total: float, samples: int = SAMPLES) -> ndarray:
        parts = residuals(*build(x, total), params, model, samples).values()
        uneven = x[:, -(SEGMENTS - 1) :]
        limited = np.sqrt(params.penalty) * np.maximum(np.abs(uneven) - MOST_UNEVEN, 0.0)
        even = np.sqrt(EVEN * params.duration) * uneven
        return np.concatenate([*parts, even, limited], axis=1) / np.sqrt(params.duration)

    value, total, x = _search(objective, tick)
    if not np.isfinite(value):
        raise PlanError(f"no path from {start_w} to {end_w} at {velocity_w} m/s")
    unit, times = (item[0] for item in build(x[None], total))
    coefficients = np.zeros((SEGMENTS, ORDER, 3))
    coefficients[..., PLANE] = unit / (times[:, None] ** np.arange(ORDER))[:, :, None]
    return Spline(times, coefficients)


def _search(objective: Callable, tick: tuple[float, float]) -> tuple[float, float, ndarray]:
    """Return objective, duration and variables of the best path, by a search on a coarse grid of
    durations from several first ones, and then on a fine grid around the best.
    """

    def improve(x: ndarray, total: float) -> tuple[ndarray, float]:
        def slope(x: ndarray) -> ndarray:
            shifted = objective(x + DIFFERENCE * np.vstack([0.0 * x, np.eye(len(x))]), total)
            return (shifted[1:] - shifted[0]).T / DIFFERENCE

        solution = least_squares(
            lambda x: objective(x[None], total)[0], x, slope, method="lm", max_nfev=EVALUATIONS
        )
        return solution.x, float((objective(solution.x[None], total, DENSE) ** 2).sum())

    blank = np.zeros(3 * (SEGMENTS - 1))
    tried = (_descend(improve, blank, np.arange(top, SHORTEST, -COARSE)) for top in LONGEST)
    best = min(tried, key=lambda solution: solution[0])
    return _descend(
        improve, best[2], _ticks(best[1] + COARSE, max(best[1] - COARSE, SHORTEST), *tick)
    )


def _descend(improve, x: ndarray, totals: ndarray) -> tuple[float, float, ndarray]:
    """Return the best path of a series with decreasing durations, each optimised from the previous
    one, until the objective is :data:`STOP_RATIO` times the best.

    Starting from a long path avoids the local optima of short paths in which the vehicle
    inverts."""
    best = (np.inf, float(totals[0]), x)
    for total in totals:
        x, value = improve(x, float(total))
        if value < best[0]:
            best = (value, float(total), x)
        elif value > STOP_RATIO * best[0]:
            break
    return best


def _ticks(high: float, low: float, period: float, offset: float) -> ndarray:
    """Return the durations, offset plus whole periods, between two limits, in descending order."""
    first = np.floor((high - offset) / period + 1e-6)
    last = np.ceil((low - offset) / period - 1e-6)
    return offset + period * np.arange(first, last - 1, -1)


def _base(begin: ndarray, end: ndarray, velocity: ndarray, total: float) -> ndarray:
    """Return waypoints on the single septic polynomial with the same duration [s] and the same ends
    up to the third derivative.
    """
    right = np.zeros((ORDER, len(begin)))
    right[0] = begin
    right[4] = end
    right[5] = velocity * total
    unit = np.linalg.solve(np.concatenate([BEGINS[:4], ENDS[:4]]), right)
    return _rows(np.arange(1, SEGMENTS) / SEGMENTS, 1)[:, 0] @ unit


def flat_reference(model: Pendulum, path: ndarray) -> tuple[ndarray, ndarray]:
    """Return states (T, 16) and inputs (T, 4) of the pendulum along a payload's path in the plane
    of x and z, given by position and five derivatives, shape (T, 6, 3).

    The vehicle pitches and does not roll or yaw. Raises PlanError: the payload is in free fall,
    where the cable's direction is undefined.

    Source: Sreenath, Lee, Kumar, CDC 2013, Lemma 1: payload position and heading are flat outputs.
    """
    chain = np.moveaxis(path[..., PLANE], 1, 0)
    if np.any(np.linalg.norm(chain[2] + UP, axis=1) < 1e-3 * GRAVITY):
        raise PlanError(
            "the planned payload falls freely; expected a taut cable along the whole path"
        )
    force, change, direction, first = _thrust(model, chain)
    pitch = np.arctan2(force[:, 0], force[:, 1])
    state = np.zeros((len(path), STATES))
    state[:, :6] = path[:, :2].reshape(-1, 6)
    state[:, [6, 8]] = direction
    state[:, 10] = direction[:, 1] * first[:, 0] - direction[:, 0] * first[:, 1]
    state[:, 13] = np.sin(0.5 * pitch)
    state[:, 15] = np.cos(0.5 * pitch)
    control = np.zeros((len(path), INPUTS))
    control[:, 0] = np.linalg.norm(force, axis=1)
    control[:, 2] = _turn(force, change) / control[:, 0] ** 2
    return state, control


def _turn(force: ndarray, change: ndarray) -> ndarray:
    """Return the pitch rate times the squared norm of planar forces, from their time derivatives,
    shape (T,).
    """
    return change[:, 0] * force[:, 1] - change[:, 1] * force[:, 0]


def _thrust(model: Pendulum, chain: ndarray) -> tuple[ndarray, ndarray, ndarray, ndarray]:
    """Return thrust vector [N], cable direction and the time derivatives of both, in the order
    thrust, derivative, direction, derivative, for a planar path (6, T, 2).
    """
    _, _, acc, jerk, snap, crackle = chain
    unit = _unit(acc + UP, jerk, snap, crackle)
    direction, first, second, third = (-x for x in unit)
    mass = model.vehicle_mass + model.payload_mass
    lever = model.vehicle_mass * model.length
    return mass * (acc + UP) - lever * second, mass * jerk - lever * third, direction, first


def _unit(*chain: ndarray) -> list[ndarray]:
    """Return the unit vector of a vector and its derivatives, from the vector and its derivatives,
    shape (T, D) each.
    """

    def dot(a: ndarray, b: ndarray) -> ndarray:
        return (a * b).sum(1, keepdims=True)

    norm = [np.sqrt(dot(chain[0], chain[0]))]  # and its derivatives
    out = [chain[0] / norm[0]]
    for k in range(1, len(chain)):
        norm.append(sum(math.comb(k - 1, i) * dot(out[k - 1 - i], chain[i + 1]) for i in range(k)))
        remainder = chain[k]
        for j in (*range(k - 1, 0, -1), k):
            remainder = remainder - math.comb(k, j) * norm[j] * out[k - j]
        out.append(remainder / norm[0])
    return out
