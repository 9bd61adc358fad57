"""Excitation that is optimised: sweeps laid over a manoeuvre, within limits, for the most expected
nats a second.

What is varied: how much of the manoeuvre is kept; a sweep of the path along each axis and one of
the heading, from one frequency to another; sweeps that are added to rates and thrust, at
frequencies that no path follows. A sweep moves as far at each of its frequencies as its share of
the limits lets, and all are made smaller until the path keeps within them, so that every design
does.

The objective is that of :class:`visthrow.diagnose.planning.plan.PlanningGoal` for the Fisher
information of the simulated flight, by the linearised model that the selection uses, over its
seconds. The search is differential evolution from a Sobol sequence about the manoeuvre: where the
rope goes slack, how near a flight comes to being aborted has no derivative. A generation's flights
are one batch.

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
"""Frequencies of a path's sweep [Hz]: once through the hall and back, and what a position loop
still follows.
"""

ADDED = 0.5, 12.0
"""Frequencies of what is added to the commands [Hz]: above the position loop, up to a quarter of
the rate of the reference's rows.
"""

OPTIMISED = ", optimised"  # end of a design's name, behind its manoeuvre's
FADE = 1.0  # in which sweeps begin and end [s]
YAW_RATE = 1.5  # of the heading's sweep [rad/s]: within what the hover controller asks for
ABORTED = 1e3  # cost of a flight that is aborted at the limit: above what any other costs [nats/s]

SCATTER_SHARE = 0.5
"""Way from the manoeuvre to the corners of the box of numbers that the first look goes at most:
with all sweeps at once, few fly.
"""

ROUNDING = 1e-9  # by which a path that is known to be safe may leave its own limits [m, m/s, m/s^2]
SCATTERED = 16  # points of the first look, a power of 2 as a Sobol sequence wants it


@dataclass(frozen=True)
class Limits:
    """The limits of vehicle and hall.

    Raises DiagnoseError: one that is not above 0, or a ceiling below the floor.
    """

    half: tuple[float, float] = (
        2.5,
        2.5,
    )  # of the hall, from its middle, that the path stays in [m]
    lowest: float = 0.8  # [m]
    highest: float = 2.6  # [m]
    speed: float = 3.0  # [m/s]
    acceleration: float = 4.0  # [m/s^2]
    # added to the body rates: that of the doublets, at which motors do not saturate [rad/s]
    rate: float = 3.0
    thrust: float = 0.4  # added to the thrust, as a share of it

    def __post_init__(self) -> None:
        numbers = np.hstack([*vars(self).values()])
        positive = np.all((numbers > 0.0) & (numbers < np.inf))
        if not (positive and self.highest > self.lowest):
            raise DiagnoseError(f"{self}: expected limits above 0, and a highest above the lowest")

    def hold(self, path: ndarray) -> bool:
        """Tell whether a path keeps within them; its rows are ``PERIOD`` apart, shape (N, 3)."""
        return np.all(_extremes(path) <= self._most + ROUNDING)

    def share(self, path: ndarray, added: ndarray) -> float:
        """Largest share of a further way, 1 at most, with which a path keeps within them."""
        if self.hold(path + added):
            return 1.0

        def excess(share: float) -> float:
            return (_extremes(path + share * added) - self._most).max() - 0.5 * ROUNDING

        return brentq(excess, 0.0, 1.0)

    def around(self, path: ndarray) -> "Limits":
        """Limits that hold a path that is known to be safe too."""
        x, y, depth, highest, *motion = np.maximum(self._most, _extremes(path)).tolist()
        return Limits((x, y), -depth, highest, *motion, self.rate, self.thrust)

    @property
    def _most(self) -> ndarray:
        """Return the limits in the order of :func:`_extremes`."""
        return np.array([*self.half, -self.lowest, self.highest, self.speed, self.acceleration])


def _extremes(path: ndarray) -> ndarray:
    """Return how far a path goes from the hall's middle along x and y, down and up [m], its speed
    [m/s] and acceleration [m/s^2], shape (6,).
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
    """Return a sine that runs from one frequency to another over a time and fades in and out, shape
    (N,).

    Args:
        t: times after its start [s], shape (N,).
        seconds: its length [s].
        low: frequency at its start [Hz].
        high: frequency at its end [Hz].
        limit: gives the amplitude at frequencies [Hz].
        phase: at its start [rad].
    """
    slope = (high - low) / seconds
    frequency = low + slope * t
    turned = 2.0 * np.pi * (low + 0.5 * slope * t) * t
    begun = rise(t, 0.0, FADE)
    ended = rise(t, seconds - FADE, FADE)
    fade = begun * (1.0 - ended)
    return limit(frequency) * fade * np.sin(turned + phase)


def _between(range_hz: tuple[float, float], share: float) -> float:
    """Return the frequency at a share of the way through a range, by its logarithm [Hz]."""
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
"""What is varied, each from 0 to 1: shares of the limits, frequencies by their logarithm."""

START = np.array([1.0, *(0.0, 0.3, 0.7) * 4, 0.0, 0.0, 0.0, 0.0, 0.7])  # the manoeuvre as it is


def designed(base: Manoeuvre, limits: Limits, numbers: ndarray) -> Manoeuvre:
    """Lay the sweeps of a vector of :data:`NUMBERS` over a manoeuvre."""
    x = dict(zip(NUMBERS, np.clip(numbers, 0.0, 1.0)))
    kept = x["kept"]
    seconds = base.seconds - 2.0 * SETTLE
    t = moving_times(base.seconds)
    limits = limits.around(base.pos_w)
    half_height = 0.5 * (limits.highest - limits.lowest)
    reaches = dict(zip("xyz", (*limits.half, half_height)))

    def swept(axis: str) -> ndarray:
        def farthest(frequency: ndarray) -> ndarray:
            turned = 2.0 * np.pi * frequency
            if axis == "yaw":
                return np.minimum(np.pi, YAW_RATE / turned)
            within = np.minimum(reaches[axis], limits.speed / turned)
            return np.minimum(within, limits.acceleration / turned**2)

        low = _between(PATH, x[f"from_{axis}"])
        high = _between(PATH, x[f"to_{axis}"])
        return x[f"share_{axis}"] * sweep(t, seconds, low, high, farthest)

    middle = np.array([0.0, 0.0, base.pos_w[0, 2]])
    ramped = middle + kept * (base.pos_w - middle)
    moved = np.column_stack([swept(axis) for axis in "xyz"])
    slow = ADDED[0]
    fast = _between(ADDED, x["added_to"])
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
        yaw=kept * base.yaw + swept("yaw"),
        rates_b=rates_b,
        thrust_factor=1.0 + kept * (base.thrust_factor - 1.0) + thrust,
    )


@dataclass(frozen=True)
class Design:
    """The best sweeps over a manoeuvre that a search found."""

    base: Manoeuvre
    manoeuvre: Manoeuvre
    numbers: ndarray  # values of :data:`NUMBERS`
    information: ndarray  # expected from the manoeuvre, see :meth:`PlanningGoal.information`
    rate: float  # expected nats a second
    start: float  # the same of ``base``
    flights: int  # number of simulated flights

    def record(self) -> dict[str, Any]:
        """For JSON."""
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

    The cost falls with the expected nats a second. An aborted flight costs more than all others,
    and the more the closer it comes to a crash."""
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
    """Find the sweeps over a manoeuvre that promise the most nats a second; None where nothing that
    was tried can be flown.

    ``steps``: generations of the search, of as many flights as the first look.
    """
    count = len(NUMBERS)
    points = qmc.Sobol(count, seed=seed).random(SCATTERED)
    scattered = START + SCATTER_SHARE * (points - START)
    tried = []  # cost and information of each simulated flight

    def best() -> tuple[float, ndarray | None]:
        return min(tried, key=lambda trial: trial[0])

    def costs(columns: ndarray) -> ndarray:
        simulated = simulate([designed(base, limits, x) for x in columns.T])
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
    manoeuvre = designed(base, limits, found.x)
    return Design(base, manoeuvre, found.x, information, -cost, -tried[0][0], len(tried))
