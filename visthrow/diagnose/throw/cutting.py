"""Flights cut into windows of about a second at changes of phase."""

from collections.abc import Sequence
from dataclasses import dataclass, replace
from itertools import pairwise

import numpy as np
from numpy import ndarray

from sim.kernels.replay.kernel import ATTACHED, LOOSE, NO_PAYLOAD
from visthrow.diagnose.throw.recorded_flight import NEVER, RecordedFlight

LENGTH = 1.0  # of a window, about [s]
SHORTEST = 0.25  # of a window [s]
BEFORE = 0.55  # length of the throw's window before the separation [s]
AFTER = 0.45  # length of the throw's window after the separation [s]
QUIET_SPEED = 0.35  # highest mean speed of a hover [m/s]
GROUND_MARGIN = 0.05  # height above the landing below which the payload's track is not used [m]
# assumed delay of the release beyond the known lag, where the rope was slack at the release [s]
LATE = 0.1
LEAST_TAUT = 0.05  # shortest taut time before the separation that shows the release [s]
# time after a rope became taut in which it may whip [s]: it bends more than ropes in calm windows
RINGING = 1.5
WINDOW_LIMIT = 100  # windows that are diagnosed within minutes; longer flights are thinned to these
TINY = 1e-12  # variance of a command that never changes
POSES_LEAST = 8  # fewest measured poses in a window


@dataclass(frozen=True)
class Cut:
    """One window of one flight."""

    flight: int
    phase: str  # hover, flight, throw or ballistic
    start: float  # [s]
    end: float  # [s]
    payload: int  # ATTACHED, LOOSE or NO_PAYLOAD, at its start
    after_slack: bool = False  # whether the rope became taut shortly before
    at_rest: bool = False  # whether the rope hung still until the window's start
    retained: bool = True  # whether its residuals are used; if not, it only carries the state on


def _split(first: float, last: float) -> list[tuple[float, float]]:
    """Split a span into equal pieces of about :data:`LENGTH`."""
    if last - first < SHORTEST:
        return []
    edges = np.linspace(first, last, max(round((last - first) / LENGTH), 1) + 1)
    return list(pairwise(edges))


def _phase(flight: RecordedFlight, first: float, last: float) -> str:
    pos = flight.vehicle.during(first, last).values
    if len(pos) < 2:
        return "flight"
    reach = np.ptp(pos, axis=0) / (last - first)
    return "hover" if np.linalg.norm(reach) < QUIET_SPEED else "flight"


def payload_down(flight: RecordedFlight, landing_height: float) -> float:
    """Return the time at which the payload is about to land, or NEVER [s]."""
    if flight.payload is None or flight.latch == NEVER:
        return flight.landing
    after = flight.payload.time > flight.latch
    low = after & (flight.payload.values[:, 2] < landing_height + GROUND_MARGIN)
    return min([flight.landing, *flight.payload.time[low][:1].tolist()])


def cut(
    flight: RecordedFlight, number: int, lag: float, landing_height: float, carries: bool
) -> list[Cut]:
    """Cut one flight into windows.

    ``lag``: known lag of the release [s]; ``landing_height``: of the payload's centre [m];
    ``carries``: whether the flight carries a payload."""
    first = flight.start
    last = flight.end
    separation = flight.latch + lag
    hanging = ATTACHED if carries else NO_PAYLOAD
    down = payload_down(flight, landing_height)
    if not carries or separation > last:
        spans = [(a, b, "", hanging) for a, b in _split(first, last)]
    else:
        before = max(first, separation - BEFORE)
        after = min(last, separation + AFTER, down)
        spans = [(a, b, "", hanging) for a, b in _split(first, before)]
        spans.append((before, after, "throw", ATTACHED))
        end = min(down, last)
        spans += [(a, b, "ballistic", LOOSE) for a, b in _split(after, end)]
        spans += [(a, b, "", NO_PAYLOAD) for a, b in _split(max(end, after), last)]
    cuts = []
    for start, end, kind, payload in spans:
        phase = kind or _phase(flight, start, end)
        previous = cuts[-1].phase if cuts else phase  # the motion before the first is unknown
        cuts.append(Cut(number, phase, start, end, payload, at_rest=previous == "hover"))
    return [c for c in cuts if len(flight.vehicle.during(c.start, c.end).time) >= POSES_LEAST]


def thin(cuts: list[Cut], flights: Sequence[RecordedFlight]) -> list[Cut]:
    """Thin long flights to :data:`WINDOW_LIMIT` windows.

    All throws and ballistic windows are kept. The others are divided into groups of neighbours, and
    the window whose commands vary most is kept from each group."""
    plain = [i for i, c in enumerate(cuts) if c.phase not in ("throw", "ballistic")]
    room = max(WINDOW_LIMIT - len(cuts) + len(plain), WINDOW_LIMIT // 4)
    if len(plain) <= room:
        return cuts
    whole = [flight.command.var(0) for flight in flights]
    variation = {}
    for i in plain:
        number = cuts[i].flight
        variation[i] = _variation(flights[number], cuts[i], whole[number])
    chosen = {max(part, key=variation.__getitem__) for part in np.array_split(plain, room)}
    dropped = set(plain) - chosen
    return [c for i, c in enumerate(cuts) if i not in dropped]


def _variation(flight: RecordedFlight, c: Cut, whole: ndarray) -> float:
    """Return the variance of a window's commands relative to that of the whole flight's."""
    acts = slice(*np.searchsorted(flight.command_time, (c.start, c.end)))
    variance = flight.command[acts].var(0)
    return (variance / np.maximum(whole, TINY)).sum()


def around_slack(c: Cut, first: float, last: float, separation: float) -> list[Cut]:
    """Cut a window around the time in which the rope was slack; the slack part is not retained.

    ``first, last``: the slack time [s]; ``separation``: of the payload [s]. If the rope is still
    slack at the separation, the last piece is the payload's free flight."""
    if c.start < separation < min(last + LEAST_TAUT, c.end):
        last = min(max(last, separation + LATE), c.end)
        afterwards = replace(c, start=last, payload=LOOSE, phase="ballistic")
    else:
        last = min(last, c.end)
        afterwards = replace(c, start=last, after_slack=True)
    before = replace(c, end=first, phase="flight" if c.phase == "throw" else c.phase)
    slack = replace(c, start=first, end=last, retained=False)
    pieces = []
    for piece in (before, slack, afterwards):
        seconds = piece.end - piece.start
        if seconds > 1e-6:
            pieces.append(replace(piece, retained=piece.retained and seconds > SHORTEST))
    return pieces
