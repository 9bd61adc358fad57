"""Optimised excitation: frequency sweeps added to a manoeuvre, within limits, for the most expected
nats a second.

The variables are the amplitude of the manoeuvre itself; a sweep of the path along each axis and one
of the heading, each between two frequencies; and sweeps added to rates and thrust, at frequencies
above those that a path can follow. The amplitude of a sweep at each frequency is a share of the
limits. The sweeps of the path are then scaled down together until the path is within the limits, so
that every design is feasible.

The objective is the gain of :class:`visthrow.diagnose.planning.plan.PlanningGoal` from the Fisher
information of the simulated flight, divided by its duration; the information comes from the
linearised model that the selection uses. The search is differential evolution from a Sobol sequence
around the manoeuvre, which needs no derivative: the margin to an abort has none where the rope goes
slack. The flights of a generation are one batch.

Source: Bayesian optimal designs: Chaloner and Verdinelli 1995; inputs for flight vehicles: Morelli
2021, multisines."""

from collections.abc import Callable
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
from numpy import ndarray
from scipy.optimize import brentq, differential_evolution
from scipy.stats import qmc

from visthrow.common.errors import DiagnoseError
from visthrow.diagnose.planning.fly_manoeuvres import Simulate, Simulated
from visthrow.diagnose.planning.manoeuvres import PERIOD, SETTLE, Manoeuvre, moving_times, rise
from visthrow.diagnose.planning.plan import PlanningGoal

PATH = 0.08, 2.0
"""Lowest and highest frequency of a path's sweep [Hz]: once through the hall and back, and the
limit of what a position loop follows.
"""

ADDED = 0.5, 12.0
"""Lowest and highest frequency of the sweeps added to commands [Hz]: above the position loop, and a
quarter of the rate of the reference's rows.
"""

OPTIMISED = ", optimised"  # suffix of a design's name, behind the manoeuvre's
FADE = 1.0  # time in which sweeps fade in and out [s]
YAW_RATE = 1.5  # largest rate of the heading's sweep [rad/s], within the hover controller's limit
ABORTED = 1e3  # cost of a flight aborted at the limit, above that of any completed one [nats/s]

SCATTER_SHARE = 0.5
"""Largest share of the way from the manoeuvre to the corners of the search box in the first
generation: few designs with all sweeps at full amplitude can be flown.
"""

ROUNDING = 1e-9  # tolerance for rounding at the limits of a path [m, m/s, m/s^2]
SCATTERED = 16  # points of the first generation; a Sobol sequence needs a power of 2


@dataclass(frozen=True)
class Limits:
    """The limits of vehicle and hall.

    Raises DiagnoseError: a limit is not above 0, or ``highest`` is not above ``lowest``.
    """

    half: tuple[float, float] = (2.5, 2.5)  # half of the hall's length and width [m]
    lowest: float = 0.8  # height [m]
    highest: float = 2.6  # height [m]
    speed: float = 3.0  # [m/s]
    acceleration: float = 4.0  # [m/s^2]
    # amplitude added to the body rates: that of the doublets, which do not saturate motors [rad/s]
    rate: float = 3.0
    thrust: float = 0.4  # amplitude added to the thrust, relative to it

    def __post_init__(self) -> None:
        numbers = np.hstack([*vars(self).values()])
        positive = np.all((numbers > 0.0) & (numbers < np.inf))
        if not (positive and self.highest > self.lowest):
            raise DiagnoseError(f"{self}: expected limits above 0, and a highest above the lowest")

    def hold(self, path: ndarray) -> bool:
        """Return whether a path is within the limits; rows ``PERIOD`` apart, shape (N, 3)."""
        return np.all(_extremes(path) <= self._most + ROUNDING)

    def share(self, path: ndarray, added: ndarray) -> float:
        """Return the largest share of ``added``, at most 1, that can be added to a path within the
        limits; both of shape (N, 3).
        """
        if self.hold(path + added):
            return 1.0

        def excess(share: float) -> float:
            return (_extremes(path + share * added) - self._most).max() - 0.5 * ROUNDING

        return brentq(excess, 0.0, 1.0)

    def around(self, path: ndarray) -> "Limits":
        """Return these limits, widened to include a path that is known to be safe."""
        x, y, depth, highest, *motion = np.maximum(self._most, _extremes(path)).tolist()
        return Limits((x, y), -depth, highest, *motion, self.rate, self.thrust)

    @property
    def _most(self) -> ndarray:
        """Return the limits in the order of :func:`_extremes`."""
        return np.array([*self.half, -self.lowest, self.highest, self.speed, self.acceleration])


def _extremes(path: ndarray) -> ndarray:
    """Return the largest values of |x|, |y|, -z and z [m], speed [m/s] and acceleration [m/s^2] of
    a path, shape (6,).
    """
    x, y, z = path.T
    vel = np.gradient(path, PERIOD, axis=0)
    acc = np.gradient(vel, PERIOD, axis=0)
    fastest = np.linalg.norm(vel, axis=1).max()
    strongest = np.linalg.norm(acc, axis=1).max()
    aside = [np.abs(x).max(), np.abs(y).max()]
    return np.array([*aside, -z.min(), z.max(), fastest, strongest])


def sweep(
    t: ndarray,
    seconds: float,
    low: float,
    high: float,
    limit: Callable[[ndarray], ndarray] = np.ones_like,
    phase: float = 0.0,
) -> ndarray:
    """Return a sine whose frequency changes linearly and whose ends fade in and out, shape (N,).

    Args:
        t: times since the start [s], shape (N,).
        seconds: duration [s].
        low: frequency at the start [Hz].
        high: frequency at the end [Hz].
        limit: gives the amplitude at frequencies [Hz].
        phase: phase at the start [rad].
    """
    slope = (high - low) / seconds
    frequency = low + slope * t
    turned = 2.0 * np.pi * (low + 0.5 * slope * t) * t
    begun = rise(t, 0.0, FADE)
    ended = rise(t, seconds - FADE, FADE)
    fade = begun * (1.0 - ended)
    return limit(frequency) * fade * np.sin(turned + phase)


def _interpolate_frequency(range_hz: tuple[float, float], share: float) -> float:
    """Return the frequency at a share of a logarithmic range [Hz]."""
    low, high = range_hz
    return low * (high / low) ** share


NUMBERS = (
    "kept",
    *(f"{what}_{axis}" for axis in ("x", "y", "z", "yaw") for what in ("share", "from", "to")),
    "rate_x",
    "rate_y",
    "rate_z",
    "thrust",
    "added_to",
)
"""Variables of the search, each from 0 to 1: shares of the limits, and of logarithmic ranges of
frequency.
"""

START = np.array([1.0, *(0.0, 0.3, 0.7) * 4, 0.0, 0.0, 0.0, 0.0, 0.7])  # the unchanged manoeuvre


def design(base: Manoeuvre, limits: Limits, numbers: ndarray) -> Manoeuvre:
    """Add the sweeps of a vector of :data:`NUMBERS` to a manoeuvre."""
    x = dict(zip(NUMBERS, np.clip(numbers, 0.0, 1.0)))
    kept = x["kept"]
    seconds = base.seconds - 2.0 * SETTLE
    t = moving_times(base.seconds)
    limits = limits.around(base.pos_w)
    half_height = 0.5 * (limits.highest - limits.lowest)
    reaches = dict(zip("xyz", (*limits.half, half_height)))

    def sweep_axis(axis: str) -> ndarray:
        def farthest(frequency: ndarray) -> ndarray:
            turned = 2.0 * np.pi * frequency
            if axis == "yaw":
                return np.minimum(np.pi, YAW_RATE / turned)
            within = np.minimum(reaches[axis], limits.speed / turned)
            return np.minimum(within, limits.acceleration / turned**2)

        low = _interpolate_frequency(PATH, x[f"from_{axis}"])
        high = _interpolate_frequency(PATH, x[f"to_{axis}"])
        return x[f"share_{axis}"] * sweep(t, seconds, low, high, farthest)

    middle = np.array([0.0, 0.0, base.pos_w[0, 2]])
    ramped = middle + kept * (base.pos_w - middle)
    moved = np.column_stack([sweep_axis(axis) for axis in "xyz"])
    slow = ADDED[0]
    fast = _interpolate_frequency(ADDED, x["added_to"])
    rates_b = kept * base.rates_b
    for i, axis in enumerate("xyz"):
        added = sweep(t, seconds, slow, fast, phase=2.0 * np.pi * i / 3.0)
        rates_b[:, i] += limits.rate * x[f"rate_{axis}"] * added
    thrust = limits.thrust * x["thrust"] * sweep(t, seconds, fast, slow)
    return replace(
        base,
        name=base.name + OPTIMISED,
        purpose="the most nats a second within the limits",
        pos_w=ramped + limits.share(ramped, moved) * moved,
        yaw=kept * base.yaw + sweep_axis("yaw"),
        rates_b=rates_b,
        thrust_factor=1.0 + kept * (base.thrust_factor - 1.0) + thrust,
    )


@dataclass(frozen=True)
class Design:
    """The best sweeps on a manoeuvre that a search found."""

    base: Manoeuvre
    manoeuvre: Manoeuvre
    numbers: ndarray  # values of :data:`NUMBERS`
    information: ndarray  # expected from the manoeuvre, see :meth:`PlanningGoal.information`
    rate: float  # expected nats a second of the manoeuvre
    start: float  # expected nats a second of ``base``
    flights: int  # number of simulated flights

    def record(self) -> dict[str, Any]:
        """Return the design for JSON."""
        return {
            "base": self.base.name,
            "manoeuvre": self.manoeuvre.name,
            "nats_a_second": self.rate,
            "of_the_base": self.start,
            "flights": self.flights,
            "numbers": dict(zip(NUMBERS, self.numbers)),
        }


def _judge(aim: PlanningGoal, simulated: Simulated, seconds: float) -> tuple[float, ndarray | None]:
    """Return the cost of a flight, and the information expected from it; None if it is aborted.

    The cost is the negative of the expected nats a second. An aborted flight costs more than any
    other, increasingly so the further it exceeds the limit."""
    if simulated.model is None:
        return ABORTED * simulated.used, None
    information = aim.information(simulated.model)
    return -aim.nats(information) / seconds, information


def optimise(
    aim: PlanningGoal,
    base: Manoeuvre,
    simulate: Simulate,
    limits: Limits,
    *,
    seed: int = 0,
    steps: int = 6,
    progress: Callable[[str], None] = lambda text: None,
) -> Design | None:
    """Find the sweeps on a manoeuvre with the most expected nats a second; None if no tried design
    can be flown.

    ``steps``: generations of the search after the first, each with as many flights.
    """
    count = len(NUMBERS)
    points = qmc.Sobol(count, seed=seed).random(SCATTERED)
    scattered = START + SCATTER_SHARE * (points - START)
    tried = []  # cost and information of each simulated flight

    def best() -> tuple[float, ndarray | None]:
        return min(tried, key=lambda trial: trial[0])

    def costs(columns: ndarray) -> ndarray:
        simulated = simulate([design(base, limits, x) for x in columns.T])
        tried.extend(_judge(aim, flight, base.seconds) for flight in simulated)
        cost, information = best()
        flown = information is not None
        text = f"{-cost:.3g} nats a second" if flown else "nothing that can be flown"
        progress(f"{len(tried)} simulated flights: {text}")
        return np.array([cost for cost, _ in tried[-len(simulated) :]])

    found = differential_evolution(
        costs,
        [(0.0, 1.0)] * count,
        init=np.vstack((START, scattered)),
        maxiter=steps,
        vectorized=True,
        updating="deferred",
        strategy="currenttobest1bin",
        mutation=(0.3, 0.6),
        recombination=0.5,
        polish=False,
        seed=seed,
    )
    cost, information = best()
    if information is None:
        return None
    manoeuvre = design(base, limits, found.x)
    return Design(base, manoeuvre, found.x, information, -cost, -tried[0][0], len(tried))
