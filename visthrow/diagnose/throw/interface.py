"""Mistakes between a log and the simulation that are either there or not: axes, signs and units of the commands.

They are looked for before any effect is estimated: such a mistake is gross, and no small deviation stands for it. Each hypothesis
must hold in all logs that can tell; the commands are then put right and the diagnosis goes on. (Commands that bear the time of
their arrival are no gross mistake: they show as the effect ``cmd_delay`` on its bound, the link's delay less.)
"""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import numpy as np

from sim.params import GRAVITY, PlantParams
from visthrow.diagnose.throw.recorded import measured
from visthrow.logs.axes import matrix_of
from visthrow.logs.check import relations, thrust
from visthrow.logs.flightlog import Channel, FlightLog

FIRMLY, CLEARLY = 0.8, 0.15
"""Correlation of commanded and measured rates that a hypothesis needs, and by how much it must beat the log as it stands."""
WORSE = 0.05
"""What a log whose own axes tell little may lose by the hypothesis."""
MOVES = 0.3  # rates that say something about their axes [rad/s]
AXES_NATS = float(np.log(48.0))  # so many ways to exchange and turn around three axes
LIFTED = 0.15  # above where it stood, from which a vehicle flies [m]
VARIED, LATE, SLOPES = 0.05, 0.05, (0.3, 2.0)  # of the throttle's hover, motors [s], plausible slopes of thrust over throttle
NEAR = 0.25  # of the logarithm of a ratio: hover thrust against weight, gain of the rates
FAR = 0.8  # the same from which another unit is considered at all


@dataclass(frozen=True)
class Mistake:
    """One hypothesis that the logs bear out."""

    name: str
    cause: str  # in words
    equation: str  # what puts it right
    nats: float  # by which it beats the log as it stands
    logs: int  # that can tell

    @property
    def sentence(self) -> str:
        """For people."""
        return f"{self.cause}: {self.name}, {self.equation}; {self.nats:.0f} nats from {self.logs} logs. It was put right."


def put_right(logs: Sequence[FlightLog], plant: PlantParams) -> tuple[list[FlightLog], tuple[Mistake, ...]]:
    """Logs with their commands as the simulation takes them, and what was wrong with them."""
    weight = GRAVITY * (plant.vehicle.body.mass + plant.rope.payload_mass + plant.rope.rope_mass)
    mended, found = _from_throttle(logs, weight)
    relation = [_followed(log) for log in mended]
    for look in (_axes, _rate_unit):
        followed = [r for r in relation if r is not None]
        mistake = look(followed) if followed else None
        if mistake is None:
            continue
        trial = [_commanded(log, matrix=mistake[1]) for log in mended]
        again = [_followed(log) for log in trial]
        if all(r is None or (s is not None and s.correlation > r.correlation - WORSE) for r, s in zip(relation, again)):
            found.append(mistake[0])
            mended, relation = trial, again
    weight = GRAVITY * plant.total_mass
    mistake = _thrust_unit(mended, weight, thrust.UNITS | {"shares of the full thrust": 4.0 * plant.vehicle.controller.max_thrust})
    if mistake is not None:
        found.append(mistake[0])
        mended = [_commanded(log, scale=mistake[1]) for log in mended]
    return mended, tuple(found)


def _from_throttle(logs: Sequence[FlightLog], weight: float) -> tuple[list[FlightLog], list[Mistake]]:
    """Logs of autopilots with commands made of throttle and commanded rates, cut to where they fly.

    Around hover the thrust of a vehicle is ``T = W (1 + s (u / h - 1))``: weight W [N] at the share h of full throttle. The slope
    s is fitted where an accelerometer tells the force and the throttle varies enough, else it is 1.
    """
    made, shares = list(logs), []
    for i, log in enumerate(logs):
        if "command" in log or "throttle" not in log or "rate_setpoint_b" not in log:
            continue
        calibration = _calibrated(log)
        if calibration is None:
            continue
        hover, slope, start, end = calibration
        rates = log["rate_setpoint_b"]
        share = log["throttle"].hold(rates.time)
        thrust_n = np.maximum(weight * (1.0 + slope * (share / hover - 1.0)), 0.0)
        values = np.column_stack([thrust_n, np.where(rates.valid[:, None], rates.values, 0.0)])
        command = Channel(rates.time, values, "N, rad/s", "body", rates.valid)
        made[i] = _between(FlightLog({**log.channels, "command": command}, log.meta), start, end)
        shares.append((hover, slope))
    if not shares:
        return made, []
    hover, slope = np.median(shares, axis=0)
    cause = "Commanded thrust is a throttle, calibrated by the weight that it carries in flight"
    equation = f"thrust = {weight:.3f} N (1 + {slope:.2f} (throttle / {hover:.3f} - 1))"
    return made, [Mistake("throttle", cause, equation, 0.0, len(shares))]


def _calibrated(log: FlightLog) -> tuple[float, float, float, float] | None:
    """Throttle in hover, slope of the thrust about it, first and last time in flight [s]; None where nothing flies."""
    channel = log["throttle"]
    time, share = channel.time[channel.valid], channel.values[channel.valid].astype(float)
    flies = share > 0.5 * np.percentile(share, 75) if np.any(share > 0.0) else np.zeros(len(share), bool)
    place = measured(log, "pos_w")
    if place is not None:
        height = np.interp(time, place.time[place.valid], place.values[place.valid][:, 2])
        flies &= height > np.min(height) + min(LIFTED, 0.5 * np.ptp(height))
    if np.count_nonzero(flies) < 50:
        return None
    start, end = float(time[flies][0]), float(time[flies][-1])
    inside = (time >= start) & (time <= end)
    hover = float(np.median(share[inside]))
    if "acc_b" not in log or np.std(share[inside]) < VARIED * hover:
        return hover, 1.0, start, end
    acc = log["acc_b"]
    grid = time[inside][(time[inside] > acc.time[0] + 0.2) & (time[inside] < acc.time[-1] - 0.2)]
    felt = relations.mean_over(acc.time[acc.valid], acc.values[acc.valid].astype(float)[:, 2:3], grid + LATE, 0.1)[:, 0] / GRAVITY
    asked = relations.mean_over(time, share[:, None], grid, 0.1)[:, 0] / hover
    slope, level = np.polyfit(asked, felt, 1)
    if not (SLOPES[0] < slope < SLOPES[1] and level + slope > 0.5):
        return hover, 1.0, start, end
    return hover * float(1.0 + (1.0 - level - slope) / slope), float(slope), start, end


def _between(log: FlightLog, start: float, end: float) -> FlightLog:
    """A stretch of a log."""
    channels = {}
    for name, c in log.channels.items():
        keep = (c.time >= start) & (c.time <= end)
        channels[name] = Channel(c.time[keep], c.values[keep], c.unit, c.frame, c.valid[keep])
    return FlightLog(channels, log.meta)


def _followed(log: FlightLog) -> relations.Relation | None:
    """How the measured attitude's rates follow the commanded ones; None where nothing turns."""
    attitude = measured(log, "quat_wb")
    if attitude is None or "command" not in log or np.count_nonzero(attitude.valid) < 50:
        return None
    command = log["command"]
    time, rate = relations.rates_of(attitude.time[attitude.valid], np.asarray(attitude.values, dtype=float)[attitude.valid])
    wanted = np.asarray(command.values, dtype=float)[command.valid, 1:]
    if len(time) < 50 or len(wanted) < 20 or np.max(np.std(rate, axis=0)) < MOVES:
        return None
    found = relations.relate(command.time[command.valid], wanted, time, rate)
    return found if found is not None and found.axes_correlation > FIRMLY else None


def _axes(relation: Sequence[relations.Relation]) -> tuple[Mistake, np.ndarray] | None:
    """Exchanged or turned axes of the commanded rates, where all logs that can tell say the same, and they are most."""
    clear = [r for r in relation if r.axes_correlation > r.correlation + CLEARLY]
    names = {r.axes for r in clear}
    nats = sum(r.nats for r in clear)
    if len(names) != 1 or 2 * len(clear) < len(relation) or nats < AXES_NATS:
        return None
    text = names.pop()
    axes = text.split(",")
    turned = sorted(axis[-1] for axis in axes) == [axis[-1] for axis in axes]
    name, cause = ("rate_sign", "A commanded rate has the other sign") if turned else ("rate_axes", "Commanded rates are exchanged")
    return Mistake(name, cause, f"x, y, z of the vehicle are ({text}) of the command", nats, len(clear)), matrix_of(text)


def _rate_unit(relation: Sequence[relations.Relation]) -> tuple[Mistake, np.ndarray] | None:
    """Degrees for radians, or radians for degrees, in the commanded rates."""
    gain = float(np.median([r.scale for r in relation if r.correlation > FIRMLY] or [1.0]))
    for factor, words in ((np.pi / 180.0, "degrees a second"), (180.0 / np.pi, "radians that were converted twice")):
        if gain > 0.0 and abs(np.log(gain / factor)) < NEAR:
            nats = float(len(relation) * 0.5 * (np.log(gain) / NEAR) ** 2)
            mistake = Mistake("rate_unit", f"Commanded rates are in {words}", f"rates times {factor:.5g}", nats, len(relation))
            return mistake, factor * np.eye(3)
    return None


def _thrust_unit(logs: Sequence[FlightLog], weight: float, units: Mapping[str, float]) -> tuple[Mistake, float] | None:
    """Another unit of the commanded thrust, from its median against the weight that it carries [N]."""
    medians = [float(np.median(c.values[c.valid, 0])) for log in logs if "command" in log and np.any((c := log["command"]).valid)]
    if not medians:
        return None
    ratio = float(np.median(medians)) / weight
    if not 0.0 < ratio < np.inf or abs(np.log(ratio)) < FAR:
        return None
    fits = {unit: abs(np.log(ratio * newtons)) for unit, newtons in units.items()}
    unit = min(fits, key=fits.get)
    if fits[unit] > NEAR or unit == "N":
        return None
    nats = float(len(medians) * 0.5 * (np.log(ratio) / NEAR) ** 2)
    mistake = Mistake("thrust_unit", f"Commanded thrust is in {unit}", f"thrust times {units[unit]:.5g}", nats, len(medians))
    return mistake, units[unit]


def _commanded(log: FlightLog, matrix: np.ndarray | None = None, scale: float = 1.0) -> FlightLog:
    """The log with other commands."""
    if "command" not in log:
        return log
    c = log["command"]
    values = np.array(c.values, dtype=float)
    values[:, 0] *= scale
    if matrix is not None:
        values[:, 1:] = values[:, 1:] @ matrix.T
    return FlightLog({**log.channels, "command": Channel(c.time, values, c.unit, c.frame, c.valid)}, log.meta)

