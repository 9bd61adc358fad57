"""Several logs of one flight, each on a clock of its own, as one flight log: what one measured twice tells how they lie.

``LOG00001.BFL+mocap.csv`` names such a flight. Body rates by gyro and by attitude, positions, or accelerations are compared;
the first log's clock counts.
"""

from collections.abc import Sequence
from dataclasses import replace

import numpy as np

from visthrow.common.constants import GRAVITY
from visthrow.common.errors import LogError
from visthrow.logs.check import relations
from visthrow.logs.flightlog import Channel, FlightLog

RATE = 50.0
"""Rate of the grid on which logs are first laid over one another [Hz]."""
LEAST = 0.6
"""Correlation of what was measured twice, below which two logs are not taken for one flight."""
_FINE = 0.1  # around the coarse answer [s]


def join(logs: Sequence[FlightLog]) -> FlightLog:
    """Put logs of one flight together; of a channel that several hold, the first log's stays.

    Raises:
        LogError: Nothing was measured in both, or it does not go together.
    """
    whole, *others = logs
    channels, meta = dict(whole.channels), dict(whole.meta)
    meta["joined"] = []
    for log in others:
        offset, correlation, by = offset_of(FlightLog(channels), log)
        moved = {name: replace(channel, time=channel.time + offset) for name, channel in log.channels.items()}
        channels = {**moved, **channels}
        source = str(log.meta.get("source", ""))
        meta["joined"].append({"source": source, "offset_s": offset, "correlation": correlation, "by": by})
        notes = {name: {**note, "clock": source} for name, note in log.meta.get("ingest", {}).items()}
        meta["ingest"] = {**notes, **meta.get("ingest", {})}
    return FlightLog(channels, meta)


def offset_of(first: FlightLog, second: FlightLog) -> tuple[float, float, str]:
    """Return what to add to the second log's times [s], the correlation then, and by which quantity.

    Raises:
        LogError: Nothing was measured in both, or it does not go together.
    """
    tried = []
    for by, signal in (("body rates", _turning), ("speed", _speed), ("force", _force)):
        a, b = signal(first), signal(second)
        if a is not None and b is not None and min(len(a[0]), len(b[0])) > RATE:
            tried.append((by, *_lag(a, b)))
    if not tried:
        raise LogError(
            f"{second.meta.get('source', 'a log')}: nothing in it that the others measured too; joining needs body rates or attitude, "
            f"positions, or accelerations in both; it has {', '.join(second.channels)}"
        )
    by, offset, correlation = max(tried, key=lambda of: of[2])
    if correlation < LEAST:
        raise LogError(f"{second.meta.get('source', 'a log')}: its {by} go with the others' by {correlation:.2f} at best: not one flight")
    return offset, correlation, by


def _turning(log: FlightLog) -> tuple[np.ndarray, np.ndarray] | None:
    """Size of the body rates, which no axes change."""
    if "rate_b" in log:
        return _size(log["rate_b"])
    if "quat_wb" not in log:
        return None
    good = log["quat_wb"].valid
    time, rate = relations.rates_of(log["quat_wb"].time[good], log["quat_wb"].values[good].astype(float))
    return time, np.linalg.norm(rate, axis=1)


def _velocity(log: FlightLog) -> tuple[np.ndarray, np.ndarray]:
    """Times and velocities from measured positions."""
    good = log["pos_w"].valid
    return relations.derivative(log["pos_w"].time[good], log["pos_w"].values[good].astype(float))


def _speed(log: FlightLog) -> tuple[np.ndarray, np.ndarray] | None:
    if "vel_w" in log:
        return _size(log["vel_w"])
    if "pos_w" not in log:
        return None
    time, vel = _velocity(log)
    return time, np.linalg.norm(vel, axis=1)


def _force(log: FlightLog) -> tuple[np.ndarray, np.ndarray] | None:
    if "acc_b" in log:
        return _size(log["acc_b"])
    if "pos_w" not in log:
        return None
    time, acc = relations.derivative(*_velocity(log))
    return time, np.linalg.norm(acc + [0.0, 0.0, GRAVITY], axis=1)


def _size(channel: Channel) -> tuple[np.ndarray, np.ndarray]:
    return channel.time[channel.valid], np.linalg.norm(channel.values[channel.valid].astype(float), axis=1)


def _lag(a: tuple[np.ndarray, np.ndarray], b: tuple[np.ndarray, np.ndarray]) -> tuple[float, float]:
    """Offset of the second [s] and the correlation: all lags at once by Fourier transform, then finely about the best."""
    grids = [np.arange(time[0], time[-1], 1.0 / RATE) for time, _ in (a, b)]
    x, y = (np.interp(grid, *signal) - np.mean(signal[1]) for grid, signal in zip(grids, (a, b)))
    size = 2 ** int(np.ceil(np.log2(len(x) + len(y))))
    cross = np.fft.irfft(np.fft.rfft(x, size) * np.conj(np.fft.rfft(y, size)), size)
    lags = np.concatenate([np.arange(len(x)), np.arange(-len(y) + 1, 0)])
    at = int(lags[np.argmax(cross[lags % size])])
    coarse = grids[0][0] - grids[1][0] + at / RATE
    best = (coarse, -1.0)
    for fine in coarse + np.arange(-_FINE, _FINE + 1e-9, 0.001):
        inside = (grids[0] > b[0][0] + fine) & (grids[0] < b[0][-1] + fine)
        if np.sum(inside) < RATE:
            continue
        correlation = float(np.corrcoef(x[inside], np.interp(grids[0][inside] - fine, *b))[0, 1])
        best = max(best, (float(fine), correlation), key=lambda of: of[1])
    return best
