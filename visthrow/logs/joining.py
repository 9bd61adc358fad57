"""Joining of several logs of one flight, each with its own clock, into one flight log.

``LOG00001.BFL+mocap.csv`` names such a flight. The offsets of the clocks follow from quantities
that two logs measured: body rates (by gyro or attitude), velocities, or accelerations. The result
is on the first log's clock. Channels that a log estimated from its other channels (``estimated`` of
its metadata) are not compared."""

from collections.abc import Sequence
from dataclasses import replace

import numpy as np
from numpy import ndarray
from scipy.signal import correlate, correlation_lags

from visthrow.common.errors import LogError
from visthrow.common.free_fall import GRAVITY
from visthrow.logs.flightlog import FlightLog
from visthrow.logs.samples import Samples

RATE = 50.0  # sampling rate of the coarse search for the offset [Hz]
# correlation of a common quantity below which two logs are not of one flight
THRESHOLD = 0.6
_FINE = 0.1  # range of the fine search, on both sides of the coarse offset [s]
_SPAN = 0.1  # averaging time of body rates [s]: 0.2 deg of attitude noise become 0.05 rad/s
_STEP = 0.001  # step of the fine search [s]; a parabola through the best three refines it
_FINE_RATE = 200.0  # sampling rate of the fine search [Hz]


def join(logs: Sequence[FlightLog]) -> FlightLog:
    """Join the logs of one flight. Of a channel in several logs, the first measured one is kept; an
    estimated one is kept only if no log measured it.

    Raises LogError: no quantity is measured in both logs, or it does not correlate.
    """
    whole, *other_logs = logs
    channels = dict(whole.channels)
    meta = dict(whole.meta)
    estimated = set(whole.meta.get("estimated", ()))
    meta["joined"] = []
    for log in other_logs:
        offset, correlation, signal = offset_of(FlightLog(channels, {"estimated": estimated}), log)
        estimated_names = set(log.meta.get("estimated", ()))
        new = {
            name
            for name in log.channels
            if name not in channels or (name in estimated and name not in estimated_names)
        }
        channels |= {name: replace(log[name], time=log[name].time + offset) for name in new}
        estimated = estimated - new | estimated_names & new
        source = str(log.meta.get("source", ""))
        meta["joined"].append(
            {"source": source, "offset_s": offset, "correlation": correlation, "by": signal}
        )
        notes = log.meta.get("ingest", {})
        meta["ingest"] = {
            **meta.get("ingest", {}),
            **{name: {**notes[name], "clock": source} for name in notes if name in new},
        }
    return FlightLog(channels, meta | {"estimated": sorted(estimated)} if estimated else meta)


def offset_of(first: FlightLog, second: FlightLog) -> tuple[float, float, str]:
    """Return the offset to be added to the second log's times [s], the correlation with it, and the
    name of the compared quantity.

    Raises LogError: no quantity is measured in both logs, or it does not correlate.
    """
    tried = []
    for method, signal in (("body rates", _compute_rates), ("speed", _velocity), ("force", _force)):
        a = signal(first.without_estimates())
        b = signal(second.without_estimates())
        if a is not None and b is not None and min(len(a[0]), len(b[0])) > RATE:
            tried.append((method, *_lag(a, b)))
    if not tried:
        raise LogError(
            f"{second.meta.get('source', 'a log')}: no quantity in common with the other logs;"
            " joining needs body rates or attitude, positions, or accelerations in both; it has"
            f" {', '.join(second.channels)}"
        )
    method, offset, correlation = max(tried, key=lambda trial: trial[2])
    if correlation < THRESHOLD:
        raise LogError(
            f"{second.meta.get('source', 'a log')}: its {method} correlate with the others' by"
            f" {correlation:.2f} at best: not the same flight"
        )
    return offset, correlation, method


def _compute_rates(log: FlightLog) -> Samples | None:
    """Return body rates averaged over ``_SPAN``, from the gyro, else from the attitude."""
    if "rate_b" not in log:
        return log["quat_wb"].samples().rates(_SPAN) if "quat_wb" in log else None
    rates = log["rate_b"].samples()
    time = rates.time
    overlap = time[(time > time[:1] + 0.5 * _SPAN) & (time < time[-1:] - 0.5 * _SPAN)]
    if not len(overlap):
        return None
    return Samples(overlap, rates.mean_over(overlap, _SPAN))


def _velocity(log: FlightLog) -> Samples | None:
    if "vel_w" in log:
        return log["vel_w"].samples()
    return log["pos_w"].samples().derivative() if "pos_w" in log else None


def _force(log: FlightLog) -> Samples | None:
    """Return the magnitude of the specific force, which does not depend on the attitude."""
    if "acc_b" in log:
        return _magnitude(*log["acc_b"].samples())
    if "pos_w" not in log:
        return None
    time, acc = log["pos_w"].samples().derivative().derivative()
    return _magnitude(time, acc + [0.0, 0.0, GRAVITY])


def _magnitude(time: ndarray, values: ndarray) -> Samples:
    return Samples(time, np.linalg.norm(values, axis=1, keepdims=True))


def _lag(a: Samples, b: Samples) -> tuple[float, float]:
    """Return the offset of the second signal [s] and the correlation of the magnitudes, which do
    not depend on the axes.

    A coarse search correlates magnitudes at all lags by Fourier transform. A fine search around its
    result compares the components after the best rotation of the axes."""
    sizes = _magnitude(*a), _magnitude(*b)
    grids = [np.arange(time[0], time[-1], 1.0 / RATE) for time, _ in sizes]
    x, y = (
        np.interp(grid, time, size[:, 0]) - np.mean(size)
        for grid, (time, size) in zip(grids, sizes)
    )
    lags = correlation_lags(len(x), len(y))
    coarse = grids[0][0] - grids[1][0] + int(lags[np.argmax(correlate(x, y, method="fft"))]) / RATE
    candidates = coarse + np.arange(-_FINE, _FINE + 1e-9, _STEP)
    scores = np.array([_alignment(*_resample_both(a, b, offset)) for offset in candidates])
    best = int(np.argmax(scores))
    offset = float(candidates[best] + _STEP * _vertex(scores, best))
    pairs = _resample_both(*sizes, offset)
    return offset, float(np.corrcoef(np.hstack(pairs).T)[0, 1]) if len(pairs[0]) >= RATE else -1.0


def _vertex(scores: ndarray, index: int) -> float:
    """Return the vertex of the parabola through a peak and its neighbours, in steps from the peak;
    0 if a neighbour is missing or the three are equal.
    """
    if not 0 < index < len(scores) - 1:
        return 0.0
    lower, top, upper = scores[index - 1 : index + 2]
    curve = 2.0 * top - lower - upper
    return 0.5 * (upper - lower) / curve if curve > 0.0 else 0.0


def _resample_both(a: Samples, b: Samples, offset: float) -> tuple[ndarray, ndarray]:
    """Return values of both signals on a grid of the first one's clock, where they overlap. The
    grid does not depend on the offset.
    """
    grid = np.arange(a[0][0], a[0][-1], 1.0 / _FINE_RATE)
    grid = grid[(grid > b[0][0] + offset) & (grid < b[0][-1] + offset)]
    return a.at(grid), b.at(grid - offset)


def _alignment(x: ndarray, y: ndarray) -> float:
    """Return the correlation of the components after the best rotation or reflection of one signal:
    the normalised sum of the covariance's singular values.
    """
    if len(x) < RATE:
        return -1.0
    x = x - np.mean(x, axis=0)
    y = y - np.mean(y, axis=0)
    return float(
        np.sum(np.linalg.svd(x.T @ y, compute_uv=False))
        / max(np.sqrt(np.sum(x**2) * np.sum(y**2)), 1e-12)
    )
