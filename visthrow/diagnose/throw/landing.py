"""Predict where payloads land, and compare with the measured landings.

Two open-loop predictions are made. The first begins a second before the separation: its initial
state is fitted to 0.4 s of measurements, and only recorded commands are used from then on, through
throw, release and ballistic flight. The second begins with a state that is fitted up to the
separation: its error comes from release and ballistic flight alone."""

from collections.abc import Iterable, Mapping
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
from numpy import ndarray
from numpy.linalg import norm

from sim.kernels.replay.kernel import ATTACHED
from visthrow.diagnose.models.model_interface import Sizes
from visthrow.diagnose.throw.cutting import (
    BEFORE,
    GROUND_MARGIN,
    LEAST_TAUT,
    SHORTEST,
    Cut,
    payload_down,
)
from visthrow.diagnose.throw.recorded_flight import NEVER, ChannelSamples, RecordedFlight
from visthrow.diagnose.throw.replay import Lane, ReplayedFlights

LEAD = 1.0  # time from the begin of the first prediction to the separation [s]
HEAD = 0.4  # its beginning, over which the initial state is fitted [s]
TRACK = 0.1  # length of the track just above the ground from which a landing is extrapolated [s]
LEAST_TRACK = 6  # fewest samples of that track
AFTERWARDS = 0.4  # simulated beyond the measured landing [s]
TICK = 5e-3  # time between points of a simulated path [s]; a chord deviates 0.03 mm from a parabola


@dataclass(frozen=True)
class PredictedLandings:
    """Measured and predicted landings of F throws; points [m] on the landing plane, in the frame of
    the measurements.
    """

    flights: ndarray  # indices of the flights, shape (F,)
    measured: ndarray  # shape (F, 3)
    predicted: ndarray  # from before the throw, shape (F, 3); NaN if the payload never lands
    released: ndarray  # from a state fitted up to the separation, shape (F, 3)

    @property
    def errors(self) -> ndarray:
        """Return the horizontal distances of predicted from measured landings [m], shape (F,)."""
        return norm(self.off, axis=1)

    @property
    def released_errors(self) -> ndarray:
        """Return the same distances for the prediction from the separation [m], shape (F,)."""
        return norm((self.released - self.measured)[:, :2], axis=1)

    @property
    def off(self) -> ndarray:
        """Return predicted minus measured landings along world x and y [m], shape (F, 2)."""
        return (self.predicted - self.measured)[:, :2]

    @classmethod
    def join(cls, parts: Iterable["PredictedLandings"]) -> "PredictedLandings":
        """Join the landings of several predictions."""
        columns = zip(*(vars(part).values() for part in parts))
        return cls(*map(np.concatenate, columns))


def estimate_landing(flight: RecordedFlight, height: float) -> tuple[float, ndarray] | None:
    """Return time [s] and point [m] of a payload's landing; None if it cannot be determined.

    If the log holds no landing, a parabola extrapolates the track just above the ground to
    ``height``."""
    if flight.latch == NEVER:
        return None
    if flight.landing_point is not None:
        return flight.landing, flight.landing_point
    if flight.payload is None:
        return None
    down = payload_down(flight, height)
    track = flight.payload.during(max(down - TRACK, flight.latch), down + TICK)
    above = track.values[:, 2] > height
    time = track.time[above] - down
    points = track.values[above]
    if len(time) < LEAST_TRACK or points[-1, 2] > height + 2.0 * GROUND_MARGIN:
        return None
    fit = np.polynomial.polynomial.polyfit(time, points, 2)
    falls = np.roots(fit[::-1, 2] - [0.0, 0.0, height])
    falls = falls[np.isreal(falls)].real
    late = falls[(falls > time[0]) & (falls < TRACK)]
    if not len(late):
        return None
    first = late.min()
    return down + first, np.polynomial.polynomial.polyval(first, fit)


def landings(
    model: Any, theta: Sizes, flights: Iterable[int] | None = None
) -> PredictedLandings | None:
    """Predict the landings of throws of a :class:`visthrow.diagnose.throw.throw_model.ThrowModel`
    with effects at ``theta``.

    ``theta``: sizes of effects in their units, 0 by default; ``flights``: indices of flights,
    default all. Returns None if no landing was measured."""
    plane = model.setting.plant.release.landing_height
    numbers = range(len(model.flights.flights)) if flights is None else flights
    before, separating, ends, points = {}, {}, {}, {}
    for n in numbers:
        landing = estimate_landing(model.flights.flights[n], plane)
        spans = None if landing is None else _spans(model, n)
        if spans is None:
            continue
        before[n], separating[n] = spans
        ends[n] = landing[0] + AFTERWARDS
        points[n] = landing[1]
    if not points:
        return None
    predicted, released = (_fly(model, theta, spans, ends) for spans in (before, separating))
    measured = np.array(list(points.values()))
    return PredictedLandings(np.array(list(points)), measured, predicted, released)


def _spans(model: Any, number: int) -> tuple[tuple[float, float], tuple[float, float]] | None:
    """Return the two spans over which a throw's state is fitted [s]: before the throw, and up to
    the separation; the rope is taut in both. None if one is too short.
    """
    flight = model.flights.flights[number]
    separation = flight.latch + model.setting.plant.release.lag
    cuts = [c for c in model.flights.cuts if c.flight == number and c.start < separation]
    if not cuts:
        return None
    slack = [c for c in cuts if not c.retained]
    slack_starts = [c.start for c in slack if c.end > separation - LEAD]
    end = min([separation - LEAD + HEAD, *slack_starts])
    begin = max(end - HEAD, cuts[0].start)
    last = max([separation - BEFORE, cuts[0].start, *[c.end for c in slack]])
    if end - begin <= SHORTEST or separation - last <= LEAST_TAUT:
        return None
    return (begin, end), (last, separation)


def _fly(
    model: Any,
    theta: Sizes,
    spans: Mapping[int, tuple[float, float]],
    ends: Mapping[int, float],
) -> ndarray:
    """Fit the states of throws over ``spans``, simulate them to ``ends``, and return the landing
    points, shape (F, 3).
    """
    cuts = []
    for n, (begin, end) in spans.items():
        cuts += _approach(model, n, begin, end)
    setting, states = model.begin(theta, cuts)
    release = setting.plant.release
    retained = [w for w, c in enumerate(cuts) if c.retained]
    flown = [replace(cuts[w], end=ends[cuts[w].flight]) for w in retained]
    looked = [_extend_path(f, ends.get(n)) for n, f in enumerate(model.flights.flights)]
    onward = ReplayedFlights(looked, flown, model.setting)
    lanes = [Lane(i, 0, w) for i, w in enumerate(retained)]
    measured = onward.fly(model.simulation(setting), states, lanes).samples
    points = []
    for i, c in enumerate(flown):
        first = 2 * onward.windows["vehicle_count"][i]
        time = onward.samples[i][2].time
        path = measured[first : first + len(time), i]
        free = time > looked[c.flight].latch + release.lag
        points.append(_find_crossing(path[free], release.landing_height))
    return np.array(points)


def _approach(model: Any, number: int, begin: float, end: float) -> list[Cut]:
    """Return a flight's windows before ``begin``, which only carry the state on, and the window
    over which its state is fitted.
    """
    before = [c for c in model.flights.cuts if c.flight == number and c.start < begin - 1e-3]
    cuts = [replace(c, end=min(c.end, begin), retained=False) for c in before]
    return [*cuts, Cut(number, "throw", begin, end, ATTACHED)]


def _extend_path(flight: RecordedFlight, end: float | None) -> RecordedFlight:
    """Replace the payload's samples by stamps that extend to ``end``."""
    if end is None:
        return flight
    time = np.arange(flight.latch, end + 1.0, TICK)
    payload = ChannelSamples(time, np.zeros((len(time), 3)), 1.0)
    return replace(flight, payload=payload, gyro=None)


def _find_crossing(path: ndarray, height: float) -> ndarray:
    """Return the point at which a path, shape (T, 3), falls through a height; NaN if it does
    not.
    """
    above = path[:, 2] > height
    down = np.flatnonzero(above[:-1] & ~above[1:])
    if not len(down):
        return np.full(3, np.nan)
    a = path[down[0]]
    b = path[down[0] + 1]
    return a + (a[2] - height) / (a[2] - b[2]) * (b - a)
