"""Suspect mistakes in the commands of a log: axes, signs and units.

Suspicions come from the way in which measured rates follow commanded ones, and from the weight that
commanded thrust carries.
:func:`visthrow.diagnose.select.diagnose_flights.correct_interface_mistakes` simulates the flights
with and without each mistake, and corrects those that raise the evidence by more than their
penalty. (Commands stamped at their arrival are no such mistake: they show as the effect
``cmd_delay``, at its bound minus the link's delay.)
"""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace

import numpy as np

from sim.params import GRAVITY, PlantParams
from visthrow.diagnose.throw.recorded_flight import find_measured
from visthrow.logs.axes import EXCHANGES, matrix_of
from visthrow.logs.check import relations, thrust_checks
from visthrow.logs.flightlog import Channel, FlightLog
from visthrow.logs.samples import Samples
from visthrow.logs.unit_names import nearest

# smallest correlation of commanded and measured rates, in the best axes, at which a log is used
FOLLOWS = 0.8
MOVES = 0.3  # smallest standard deviation of rates that shows their axes [rad/s]
LIFTED = 0.15  # height above the start from which a vehicle counts as flying [m]
VARIED = 0.05  # smallest variation of throttle, relative to hover, that shows the slope of thrust
LATE = 0.05  # lag of the motors behind throttle [s]
SLOPES = (0.3, 2.0)  # plausible slopes of thrust over throttle


@dataclass(frozen=True)
class Mistake:
    """A possible mistake in the commands of all logs."""

    name: str
    cause: str  # in words
    equation: str  # the correction
    nats: float  # evidence for it
    logs: int  # number of logs that show it
    ways: int = 1  # number of alternatives of the same kind; its logarithm is the penalty
    # matrix of the correction of thrust and rates, shape (4, 4); empty where the command was
    # derived
    change: Sequence[Sequence[float]] = ()

    @property
    def sentence(self) -> str:
        """Describe the mistake and its correction for the report."""
        return (
            f"{self.cause}: {self.name}, {self.equation}; {self.nats:.0f} nats from {self.logs}"
            " logs. It was corrected."
        )

    def mend(self, log: FlightLog) -> FlightLog:
        """Return the log with corrected commands."""
        if "command" not in log:
            return log
        c = log["command"]
        values = np.asarray(c.values, dtype=float) @ np.transpose(self.change)
        return replace(log, channels={**log.channels, "command": replace(c, values=values)})


def suspect(logs: Sequence[FlightLog], plant: PlantParams) -> list[Mistake]:
    """List possible mistakes in the commands of all logs, in the order of correction. Their
    evidence is not yet known.
    """
    full = 4.0 * plant.vehicle.controller.max_thrust
    units = thrust_checks.UNITS | {"shares of the full thrust": full}
    mistakes = []
    related = None
    for look in (_axes, _rate_unit):
        related = related or list(filter(None, map(_relate_rates, logs)))
        if related and (mistake := look(related)) is not None:
            mistakes.append(mistake)
            logs = list(map(mistake.mend, logs))
            related = None  # corrected commands relate otherwise
    mistake = _thrust_unit(logs, GRAVITY * plant.total_mass, units)
    return mistakes if mistake is None else [*mistakes, mistake]


def derive_commands(
    logs: Sequence[FlightLog], plant: PlantParams
) -> tuple[list[FlightLog], tuple[Mistake, ...]]:
    """Derive commands from throttle and commanded rates where an autopilot's log has no commands.

    Around hover the thrust of a vehicle is ``T = W (1 + s (u / h - 1))``: weight W [N] at the share
    h of full throttle. The slope s is fitted if an accelerometer measures the force and the
    throttle varies enough; otherwise it is 1. Returns the logs, cut to the time in flight, and what
    was derived."""
    weight = GRAVITY * plant.total_mass
    corrected = list(logs)
    shares = []
    for i, log in enumerate(logs):
        if "command" in log or "throttle" not in log or "rate_setpoint_b" not in log:
            continue
        calibration = _calibrate(log)
        if calibration is None:
            continue
        hover, slope, start, end = calibration
        rates = log["rate_setpoint_b"]
        share = log["throttle"].hold(rates.time)
        thrust_n = np.maximum(weight * (1.0 + slope * (share / hover - 1.0)), 0.0)
        turns = np.where(rates.valid[:, None], rates.values, 0.0)
        values = np.column_stack([thrust_n, turns])
        command = Channel(rates.time, values, "N, rad/s", "body", rates.valid)
        flown = {}
        for name, channel in {**log.channels, "command": command}.items():
            in_flight = (channel.time >= start) & (channel.time <= end)
            flown[name] = channel.only(in_flight)
        corrected[i] = replace(log, channels=flown)
        shares.append((hover, slope))
    if not shares:
        return corrected, ()
    hover, slope = np.median(shares, axis=0)
    cause = "Commanded thrust is a throttle, calibrated by the weight that it carries in flight"
    equation = f"thrust = {weight:.3f} N (1 + {slope:.2f} (throttle / {hover:.3f} - 1))"
    return corrected, (Mistake("throttle", cause, equation, 0.0, len(shares)),)


def _calibrate(log: FlightLog) -> tuple[float, float, float, float] | None:
    """Return the throttle in hover, the slope of the thrust there, and the first and last time in
    flight [s]; None if the vehicle does not fly.
    """
    throttle = log["throttle"].samples()
    time = throttle.time
    share = throttle.values[:, 0]
    flies = share > 0.5 * np.percentile(share, 75) if np.any(share > 0.0) else share > 0.0
    place = find_measured(log, "pos_w")
    if place is not None:
        height = place.at(time)[:, 2]
        flies &= height > height.min() + min(LIFTED, 0.5 * np.ptp(height))
    if np.count_nonzero(flies) < 50:
        return None
    start = time[flies][0]
    end = time[flies][-1]
    rows = (time >= start) & (time <= end)
    hover = np.median(share[rows])
    if "acc_b" not in log or share[rows].std() < VARIED * hover:
        return hover, 1.0, start, end
    acc = log["acc_b"].samples()
    first, last = acc.time[[0, -1]]
    grid = time[rows & (time > first + 0.2) & (time < last - 0.2)]
    force = acc.mean_over(grid + LATE, 0.1)[:, 2] / GRAVITY
    commanded = throttle.mean_over(grid, 0.1)[:, 0] / hover
    slope, level = np.polyfit(commanded, force, 1)
    if not (SLOPES[0] < slope < SLOPES[1] and level + slope > 0.5):
        return hover, 1.0, start, end
    return hover * (1.0 + (1.0 - level - slope) / slope), slope, start, end


def _relate_rates(log: FlightLog) -> relations.Relation | None:
    """Relate the measured attitude's rates to the commanded ones; None if the vehicle hardly
    turns.
    """
    attitude = find_measured(log, "quat_wb")
    if attitude is None or "command" not in log or len(attitude.time) < 50:
        return None
    rates = attitude.rates()
    time, command = log["command"].samples()
    if len(rates.time) < 50 or len(time) < 20 or rates.values.std(0).max() < MOVES:
        return None
    relation = relations.relate(Samples(time, command[:, 1:]), rates)
    return relation if relation is not None and relation.axes_correlation > FOLLOWS else None


def _axes(relation: Sequence[relations.Relation]) -> Mistake | None:
    """Return exchanged or reversed axes of the commanded rates, if most logs show them and all of
    these agree.
    """
    clear = [r for r in relation if r.nats > 0.0]
    if len({r.axes for r in clear}) != 1 or 2 * len(clear) < len(relation):
        return None
    text = clear[0].axes
    axes = [axis[-1] for axis in text.split(",")]
    words = "rate_axes", "Commanded rates are exchanged"
    if sorted(axes) == axes:
        words = "rate_sign", "A commanded rate has the other sign"
    change = np.eye(4)
    change[1:, 1:] = matrix_of(text)
    nats = sum(r.nats for r in clear)
    equation = f"x, y, z of the vehicle are ({text}) of the command"
    return Mistake(*words, equation, nats, len(clear), len(EXCHANGES), change.tolist())


def _rate_unit(relation: Sequence[relations.Relation]) -> Mistake | None:
    """Return a wrong unit of the commanded rates: degrees for radians, or the reverse."""
    gain = np.median([r.scale for r in relation if r.correlation > FOLLOWS] or [1.0])
    factors = {
        "radians a second": 1.0,
        "degrees a second": np.pi / 180.0,
        "radians that were converted twice": 180.0 / np.pi,
    }
    unit, _ = nearest(1.0 / gain, factors)
    factor = factors[unit]
    if factor == 1.0:
        return None
    change = np.diag([1.0, factor, factor, factor])
    cause = f"Commanded rates are in {unit}"
    equation = f"rates times {factor:.5g}"
    numbers = len(relation), len(factors)
    return Mistake("rate_unit", cause, equation, 0.0, *numbers, change.tolist())


def _thrust_unit(
    logs: Sequence[FlightLog], weight: float, units: Mapping[str, float]
) -> Mistake | None:
    """Return a wrong unit of the commanded thrust: the one that makes its median closest to the
    weight that it carries [N].
    """
    commands = [c for log in logs if (c := find_measured(log, "command")) is not None]
    medians = [np.median(c.values[:, 0]) for c in commands]
    ratio = np.median(medians) / weight if medians else 0.0
    if not 0.0 < ratio < np.inf:
        return None
    unit, _ = nearest(ratio, units)
    if unit == "N":
        return None
    change = np.diag([units[unit], 1.0, 1.0, 1.0])
    cause = f"Commanded thrust is in {unit}"
    equation = f"thrust times {units[unit]:.5g}"
    numbers = len(medians), len(units)
    return Mistake("thrust_unit", cause, equation, 0.0, *numbers, change.tolist())
