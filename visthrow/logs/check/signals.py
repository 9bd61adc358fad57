"""Checks of one channel by itself: clock, gaps, stuck and saturated values, jumps and sensor
noise.
"""

from collections.abc import Iterator

import numpy as np

from visthrow.common.rotations import continuous
from visthrow.logs.check.rows import Row
from visthrow.logs.flightlog import Channel

MAD_TO_SIGMA = 1.4826
FEW_SAMPLES = 20
# Values with a longer period [s] are settled ones, such as a thrust stand's: FEW_STEPS suffice.
SLOW_PERIOD = 0.5
FEW_STEPS = 5
SHORT = 0.5  # shortest duration of a usable channel [s]
LONG = 1800.0  # of longer logs, only windows spread over the flight are simulated [s]

_GAP_PERIODS = 3.0
_JITTER_WARN = 0.25  # of a period, 95th percentile
# longest time for which a moving vehicle's pose may repeat to the last digit [s]
_STUCK_TIME = 0.25
_RAIL_SHARE = 0.01
_RAILED = (
    "command",
    "motor_command",
    "motor_output",
    "pwm",
    "acc_b",
    "rate_b",
    "throttle",
    "motor_speed",
)
# channels with few possible values
_SWITCHES = ("release_command", "attached", "flying", "mode")
_NEVER_STUCK = ("pos", "quat", "vel", "rate", "acc", "payload", "angle")
_FASTEST = {"m": 30.0, "1": 20.0, "m/s": 1e3, "rad/s": 5e3, "m/s^2": 5e4, "rad": 50.0, "V": 500.0}
"""Unit -> rate of change [unit/s] above which a step is a jump: of vehicles, rotors and batteries.
"""
_NOTES = {
    "repeated": "stamps repeated",
    "backwards": "stamps going back",
    "unstamped": "rows unstamped",
}
"""Key of a count in a reader's notes -> its text."""
_HARDEST = 30.0  # acceleration of a vehicle or payload that throws [m/s^2]
_COMMANDED = (
    "setpoint",
    "command",
    "action",
    "observation",
    "goal",
    "keypoints",
    "throttle",
    "motor",
    "pwm",
    "residual",
)
"""Words of channels that may step, as they are commanded or no motion."""
_STOPS_AT_ZERO = ("throttle", "motor_command", "command", "motor_output", "pwm", "motor_speed")


def highpass_sigma(values: np.ndarray, good: np.ndarray | slice = slice(None)) -> np.ndarray:
    """Return the standard deviation of white sensor noise on a smooth signal, robust to outliers.

    Third differences of a motion that is smooth over four samples vanish. Those of white noise have
    20 times its variance. ``values``: evenly sampled, shape (T,) or (T, D), T >= 4; ``good``: third
    differences that are used. Returns sigma in the values' unit, shape () or (D,).

    Source: Rousseeuw and Croux 1993 for the median absolute deviation.
    """
    third = np.diff(np.asarray(values, dtype=float), n=3, axis=0)[good]
    return (
        MAD_TO_SIGMA * np.median(np.abs(third - np.median(third, axis=0)), axis=0) / np.sqrt(20.0)
    )


def noise(channel: Channel) -> np.ndarray:
    """Return the standard deviation of the sensor's noise, from third differences of evenly spaced
    samples.

    Returns one value per component, in the channel's unit; NaN if there are too few samples.
    """
    values = channel.rows
    steps = np.diff(channel.time)
    even = np.abs(steps - np.median(steps)) < 0.5 * np.median(steps) if len(steps) else steps > 0.0
    good = channel.valid[:-3] & channel.valid[3:] & even[:-2] & even[1:-1] & even[2:]
    if len(values) < FEW_SAMPLES or np.sum(good) < FEW_SAMPLES:
        return np.full(values.shape[1], np.nan)
    return sensor_sigma(values, good)


def sensor_sigma(values: np.ndarray, good: np.ndarray | slice = slice(None)) -> np.ndarray:
    """Return the larger of :func:`highpass_sigma` and the rounding error's deviation, shape (D,): a
    rounded component that hardly moves shows no noise.
    """
    return np.maximum(highpass_sigma(values, good), _resolution(values) / np.sqrt(12.0))


def _resolution(values: np.ndarray) -> np.ndarray:
    """Return the smallest step between the values of each column; 0 for unrounded columns."""
    steps = np.zeros(values.shape[1])
    for i, column in enumerate(values.T):
        distinct = np.unique(column)
        if 1 < len(distinct) < 0.5 * len(column):
            steps[i] = np.min(np.diff(distinct))
    return steps


def look(name: str, channel: Channel, notes: dict) -> Iterator[Row]:
    """Yield the findings of all checks of one channel; ``notes``: the reader's counts of rejected
    rows, see :func:`visthrow.logs.readers.table_to_log.make_channel`.
    """
    count = len(channel.time)
    span = np.ptp(channel.time) if count else 0.0
    figures = {"samples": count, "seconds": span}
    if count >= FEW_STEPS and span > SLOW_PERIOD * count:
        text = f"{count} settled values over {span:.0f} s"
        yield Row("clock", name, "ok", text, figures)
    elif notes.get("held") and not _speaks_of(name, _NEVER_STUCK):
        text = f"{count} values over {span:.1f} s, each held until it changes"
        yield Row("clock", name, "ok", text, figures)
    elif count < FEW_SAMPLES or span < SHORT:
        text = (
            f"{count} samples over {span:.2f} s; at least {FEW_SAMPLES} over {SHORT} s are needed"
        )
        event = name in (*_SWITCHES, "separation", "landing", "goal_w")
        yield Row("clock", name, "ok" if event else "bad", text, figures)
    else:
        yield _clock(name, channel, notes)
        yield from _gaps(name, channel)
        yield from _values(name, channel)
        yield from _noise(name, channel)


def _clock(name: str, channel: Channel, notes: dict) -> Row:
    steps = np.diff(channel.time)
    count = len(channel.time)
    period = np.median(steps)
    span = np.ptp(channel.time)
    jitter = np.percentile(np.abs(steps - period), 95) / period
    rate = 1.0 / period
    figures = {"samples": count, "seconds": span, "rate_hz": rate, "jitter_of_period": jitter}
    text = f"{count} samples, {span:.1f} s, {rate:.4g} Hz, jitter {100 * jitter:.0f} % of a period"
    verdict = "warn" if jitter > _JITTER_WARN else "ok"
    for key, words in _NOTES.items():
        if notes.get(key):
            verdict = "warn"
            text += f"; {notes[key]} {words}"
            figures[key] = notes[key]
    rows = notes.get("rows", len(steps))
    if max(notes.get("repeated", 0), notes.get("backwards", 0)) > 0.05 * rows:
        verdict = "bad"
    if notes.get("held"):
        text += f"; {notes['held']} repetitions of a held value left out"
        figures["held"] = notes["held"]
    if span > LONG:
        verdict = "warn" if verdict == "ok" else verdict
        text += "; long: models look at windows spread over it"
    return Row("clock", name, verdict, text, figures)


def _gaps(name: str, channel: Channel) -> Iterator[Row]:
    steps = np.diff(channel.time)
    period = np.median(steps)
    wide = steps > _GAP_PERIODS * period
    gaps = int(np.sum(wide))
    longest = np.max(steps)
    invalid = np.mean(~channel.valid)
    if not gaps and invalid == 0.0:
        return
    share = np.sum(steps[wide] - period) / np.ptp(channel.time)
    figures = {"gaps": gaps, "longest_s": longest, "lost_share": share, "invalid_share": invalid}
    if invalid + share > 0.5:
        verdict = "bad"
    elif invalid + share > 0.02 or longest > 0.5:
        verdict = "warn"
    else:
        verdict = "ok"
    text = (
        f"{gaps} gaps, the longest {longest:.3f} s; {100 * share:.1f} % of the"
        f" time, {100 * invalid:.1f} % of the samples not valid"
    )
    yield Row("gaps", name, verdict, text, figures)


def _values(name: str, channel: Channel) -> Iterator[Row]:
    time, values = channel.samples()
    if len(values) < FEW_SAMPLES:
        yield Row("values", name, "bad", f"{len(values)} valid samples")
        return
    measured = "setpoint" not in name
    if measured and _speaks_of(name, _NEVER_STUCK):
        yield from _report_stuck(name, values, time)
    if measured and _speaks_of(name, _RAILED) and name not in _SWITCHES:
        yield from _check_rails(name, values)
    if channel.unit in _FASTEST and not _speaks_of(name, _COMMANDED):
        yield from _jumps(name, values, time, channel.unit)


def _speaks_of(name: str, words: tuple[str, ...]) -> bool:
    """Return whether a channel's name contains one of some words."""
    return any(word in name for word in words)


def _report_stuck(name: str, values: np.ndarray, time: np.ndarray) -> Iterator[Row]:
    same = np.all(np.diff(values, axis=0) == 0.0, axis=1)
    if not np.any(same):
        return
    changes = np.flatnonzero(~same)
    firsts = np.append(0, changes + 1)
    lengths = time[np.append(changes, len(same))] - time[firsts]
    longest = np.max(lengths)
    start = time[firsts[np.argmax(lengths)]]
    total = np.sum(lengths[lengths > _STUCK_TIME])
    share = np.mean(same)
    figures = {"longest_s": longest, "at_s": start, "stuck_s": total, "repeated_share": share}
    if np.all(same):
        yield Row("values", name, "bad", "one value from beginning to end", figures)
    elif longest > _STUCK_TIME:
        verdict = "bad" if total > 0.3 * np.ptp(time) else "warn"
        text = f"stands still to the last digit for {longest:.2f} s at {start:.2f} s"
        yield Row("values", name, verdict, text, figures)
    elif share > 0.2:
        text = (
            f"{100 * share:.0f} % of the samples repeat the one before: measured more slowly than"
            " logged, or rounded"
        )
        yield Row("values", name, "warn", text, figures)


def _check_rails(name: str, values: np.ndarray) -> Iterator[Row]:
    rails = [(0.0, "")]
    stops = _speaks_of(name, _STOPS_AT_ZERO)  # switched off is no rail
    for column in values.T[np.ptp(values, axis=0) > 0.0]:
        ends = {"highest": np.max(column)}
        if not stops:
            ends["lowest"] = np.min(column)
        for words, rail in ends.items():
            share = (np.sum(column == rail) - 1) / len(column)  # one sample always is the extreme
            rails.append((share, f"its {words} value {rail:.6g}"))
    worst, where = max(rails)
    if worst > _RAIL_SHARE:
        text = f"{100 * worst:.1f} % of the samples at {where}: saturated"
        yield Row("values", name, "warn", text, {"share": worst})


def _jumps(name: str, values: np.ndarray, time: np.ndarray, unit: str) -> Iterator[Row]:
    """Report steps too fast for a motion, between neighbouring samples and across gaps."""
    if "quat" in name:
        values = continuous(values)
    size = np.linalg.norm(np.diff(values, axis=0), axis=1)
    steps = np.diff(time)
    usual = np.maximum(np.percentile(size, 99), 1e-9)
    adjacent = steps < 5 * np.median(steps)
    jumped = (size > 5.0 * usual) & (size / steps > _FASTEST[unit]) & adjacent
    unit_word = "" if unit == "1" else f" {unit}"
    if np.any(jumped):
        index = int(np.argmax(np.where(jumped, size, 0.0)))
        count = int(np.sum(jumped))
        largest = f"{size[index]:.3g}{unit_word} at {time[index]:.2f} s"
        verdict = "warn" if np.mean(jumped) < 0.02 else "bad"
        text = f"{count} jumps, the largest {largest}"
        yield Row("values", name, verdict, text, {"jumps": count})
    if unit == "m":
        yield from _jumps_across(name, values, time, np.flatnonzero(~adjacent))


def _jumps_across(
    name: str, values: np.ndarray, time: np.ndarray, gaps: np.ndarray
) -> Iterator[Row]:
    """Report positions that are not continued after a gap: another origin, or another body."""
    off = []
    for i in gaps:
        before = slice(max(i - 8, 0), i + 1)
        after = slice(i + 1, i + 10)
        if min(len(time[before]), len(time[after])) < 5:
            continue
        middle = 0.5 * (time[i] + time[i + 1])
        ends = [np.polyfit(time[part] - middle, values[part], 1)[1] for part in (before, after)]
        distance = np.linalg.norm(ends[1] - ends[0])
        width = time[i + 1] - time[i]
        if distance > 0.05 + 0.25 * _HARDEST * width**2:
            off.append((distance, time[i], width))
    if not off:
        return
    distance, instant, width = max(off)
    text = (
        f"{len(off)} jumps across gaps, the largest {distance:.3g} m over the {width:.2f} s from"
        f" {instant:.2f} s: another origin or body?"
    )
    yield Row("values", name, "warn", text, {"jumps_across_gaps": len(off), "largest_m": distance})


def _noise(name: str, channel: Channel) -> Iterator[Row]:
    sigma = noise(channel)
    known = np.all(np.isfinite(sigma)) and np.any(sigma > 0.0)
    if known and channel.values.dtype.kind != "b":
        text = f"sd of the noise {', '.join(f'{s:.3g}' for s in sigma[:4])} {channel.unit}"
        yield Row("noise", name, "ok", text, {"sigma": sigma.tolist(), "unit": channel.unit})
