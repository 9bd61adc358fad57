"""What varies from flight to flight: the deviation of an effect among flights, from the scatter of the flights' own scores.

About the sizes that were found, the score u of an effect in flight f is normal with variance i + i^2 theta^2: i is the flight's
information, theta the deviation that is looked for. Effects that are not named stay below their floors and add what they could.
"""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import numpy as np

from visthrow.diagnose.catalogue.scatter import VARYING, Varying
from visthrow.diagnose.evidence import SPIKE, Priors
from visthrow.diagnose.marginal import Statistics

LEAST_FLIGHTS = 4
"""With fewer a deviation is anybody's guess."""
REACH = np.geomspace(0.02, 6.0, 400)
"""Deviations that are tried, in their prior's."""


@dataclass(frozen=True)
class Scatter:
    """The verdict on one quantity that may vary."""

    name: str
    cause: str
    equation: str
    block: str
    unit: str
    of: tuple[str, ...]
    found: bool
    size: float  # most probable deviation [unit]
    low: float  # 95 % interval [unit]
    high: float
    floor: float  # [unit]
    nats: float  # of evidence that it varies at all
    flights: int  # that say something about it
    manoeuvres: tuple[str, ...] = ()

    @property
    def sentence(self) -> str:
        """For people."""
        size = f"{self.name} = {self.size:.3g} {self.unit} (95 %: {self.low:.3g} to {self.high:.3g})"
        return f"{self.cause}: {size}, {self.nats:.0f} nats from {self.flights} flights."


def varying(statistics: Statistics, theta: np.ndarray, priors: Priors, names: Sequence[str], least: float) -> tuple[Scatter, ...]:
    """Verdicts on everything that may vary among these flights.

    Args:
        statistics: of the flights.
        theta: sizes found, in floors, shape (K,).
        priors: of the effects.
        names: of the effects.
        least: nats that a finding needs.
    """
    known, told = list(names), {}
    drawn = np.zeros(len(theta))  # variances of what is known to vary, in floors
    for _ in VARYING:
        free = [v for v in VARYING if not (v.name in told and told[v.name].found)]
        at = {v.name: [known.index(name) for name in v.of if name in known] for v in free}
        new = [s for v in free if (s := _verdict(v, statistics, theta, priors, at[v.name], least, drawn)) is not None]
        best = max((s for s in new if s.found), key=lambda s: s.nats, default=None)
        told |= {s.name: s for s in new if not s.found or s is best}
        if best is None:
            break
        drawn[at[best.name]] = (best.size / priors.floor[at[best.name]]) ** 2
    return tuple(told.values())


def _verdict(
    v: Varying, statistics: Statistics, theta: np.ndarray, priors: Priors, at: Sequence[int], least: float,
    drawn: np.ndarray,
) -> Scatter | None:
    at = [j for j in at if priors.visible[j]]
    own = statistics.information[:, at, at] if at else np.zeros((0, 0))
    seen = (own > 0.0).any(axis=1) if at else np.zeros(0, dtype=bool)
    if np.count_nonzero(seen) < LEAST_FLIGHTS:
        return None
    score = statistics.score - statistics.information @ (theta - statistics.theta)
    size = np.append(0.0, REACH * v.prior_sd)
    value = np.zeros(len(size))
    for j in at:
        i, u = statistics.information[seen, j, j], score[seen, j]
        shared = np.where(np.arange(len(theta)) == j, 0.0, SPIKE**2 + drawn)
        plain = i + statistics.information[seen][:, j] ** 2 @ shared
        spread = plain[:, None] + (i[:, None] * size / priors.floor[j]) ** 2
        value += (-0.5 * np.log(spread) - 0.5 * u[:, None] ** 2 / spread).sum(axis=0)
    weight = np.gradient(size) * np.sqrt(2.0 / np.pi) / v.prior_sd * np.exp(-0.5 * (size / v.prior_sd) ** 2)
    best = value.max()
    density = np.exp(value - best) * weight
    share = np.cumsum(density) / density.sum()
    low, high = (float(size[np.searchsorted(share, q)]) for q in (0.025, 0.975))
    nats = float(np.log(density.sum()) + best - value[0])
    most = float(size[np.argmax(density / np.gradient(size))])
    return Scatter(v.name, v.cause, v.equation, v.block, v.unit, tuple(v.of), nats > least and most > v.floor, most, low, high,
                   v.floor, nats, int(np.count_nonzero(seen)), v.manoeuvres)  # fmt: skip


def variances(scatter: Sequence[Mapping]) -> dict[str, float]:
    """Variance of each effect among flights, from the scatter that a diagnosis' JSON tells was found."""
    return {name: float(s["size"]) ** 2 for s in scatter if s["found"] for name in s["of"]}
