"""Statistics of the stream of a body's poses: rate, gaps, rejections and quality of the stamps.

The run and ``visthrow hil check`` judge the stream by the same limits before the take-over. The
text of each problem states what was measured, what is required and what to do."""

import math
from collections import Counter, deque
from dataclasses import dataclass

import numpy as np

from hil.poses.estimate import MOST_SAMPLES, EstimateParams
from hil.poses.gate import REASONS, GateParams
from hil.poses.pose import Pose

WINDOW = 2.0  # of arrivals that are judged [s]
SETTLING = 0.5  # time of arrivals before the first judgement [s]
JUDGE_INTERVAL = 0.1  # between two judgements [s]
MOST_KEPT = 10_000  # poses in a window

MOST_REFUSED = 0.05  # share of poses that the gate may reject beside repeated ones
MOST_STALE = 0.1  # share of time in which the content may be older than gate.warn
MOST_DRIFT = 0.1  # by which a second of stamps may differ from one of arrivals
MOST_CLOSE = 0.2  # share of intervals that may be shorter than a quarter of their mean

LEAST_SCATTER = 0.0015
SCATTER = 0.2
"""Tolerated scatter of intervals [s], and as a share of their mean: at 3 m/s the error of a
position is less than a centimetre.
"""


@dataclass(frozen=True)
class Flow:
    """Statistics of a body's poses over the last seconds; NaN with too few poses."""

    count: int  # of received poses
    rate: float  # of accepted ones [Hz]
    refused: Counter  # by reason
    gap: float  # longest time without an accepted one [s]
    stale: float  # share of time in which the content was older than gate.warn
    close: float  # share of arrivals less than a quarter of the mean interval after the last one
    stamps: tuple[float, ...]  # first, last and number of different ones [s, s, -]
    backward: float  # share of stamps before the last one's
    drift: float  # of stamps in a second of arrivals, less one
    scatter: float  # of the accepted stamps' intervals, multiples of their mean taken off [s]
    bunched: float  # as ``close``, of accepted stamps
    transit: float  # spread of arrival less stamp, 10 to 90 %, where no clock is known [s]

    def text(self) -> str:
        """Return a text on the regularity."""
        return (
            f"gaps up to {1e3 * self.gap:.0f} ms, {100 * self.close:.0f} % of the arrivals bunched,"
            f" stamps scatter by {1e3 * self.scatter:.1f} ms"
        )


class Stream:
    """A monitor of one body's poses."""

    def __init__(self, gate: GateParams, estimate: EstimateParams):
        """Set the parameters of the gate and the estimate, from which the limits follow."""
        self._gate = gate
        self._estimate = estimate
        self._rows: deque[tuple[float, float, str | None, bool]] = deque(maxlen=MOST_KEPT)
        self._first: float | None = None
        self._judged: tuple[float, list[str]] = (-math.inf, [])

    def note(self, pose: Pose, reason: str | None) -> None:
        """Record a raw pose and why it was rejected, or None."""
        if self._first is None:
            self._first = pose.arrival
        rows = self._rows
        rows.append((pose.arrival, pose.stamp, reason, pose.measured is not None))
        while pose.arrival - rows[0][0] > WINDOW:
            rows.popleft()

    def flow(self, time: float) -> Flow | None:
        """Return the statistics of the last seconds at a time [s]; None before enough time has
        passed.
        """
        if self._first is None or time - self._first < SETTLING:
            return None
        begin = max(self._first, time - WINDOW)
        rows = [row for row in self._rows if row[0] >= begin]
        arrivals, stamps = (np.array([row[i] for row in rows]) for i in (0, 1))
        good = np.array([row[2] is None for row in rows], bool)
        stamps[~np.isfinite(stamps)] = math.nan
        steps = np.diff(stamps)
        taken = stamps[good]
        waits = np.diff(np.concatenate([[begin], arrivals[good], [time]]))
        late = np.maximum(waits - self._gate.warn, 0.0).sum()
        unknown = good & ~np.array([row[3] for row in rows], bool)
        passed = (arrivals - stamps)[unknown]
        span = float(arrivals[-1] - arrivals[0]) if len(rows) > 1 else 0.0
        return Flow(
            len(rows),
            good.sum() / (time - begin),
            Counter(row[2] for row in rows if row[2] is not None),
            float(waits.max()),
            float(late / (time - begin)),
            _share_close(np.diff(arrivals)),
            (float(stamps[0]), float(stamps[-1]), len(set(stamps))) if len(rows) else (),
            float(np.mean(steps < 0.0)) if len(steps) else math.nan,
            float((stamps[-1] - stamps[0]) / span - 1.0) if span > 0.0 else math.nan,
            _scatter(np.diff(taken)),
            _share_close(np.diff(taken)),
            float(np.subtract(*np.quantile(passed, [0.9, 0.1]))) if len(passed) else math.nan,
        )

    def problems(self, time: float) -> list[str]:
        """Return texts on why the last seconds' poses are not good enough for an estimate;
        updated every :data:`JUDGE_INTERVAL`.
        """
        if time - self._judged[0] >= JUDGE_INTERVAL:
            self._judged = (time, self._judge(time))
        return self._judged[1]

    def _judge(self, time: float) -> list[str]:
        flow = self.flow(time)
        if flow is None or not flow.count:
            return []
        problems = self._stamps(flow)
        refused = sum(n for reason, n in flow.refused.items() if reason != "repeated")
        share = refused / flow.count
        if share > MOST_REFUSED and not (problems and set(flow.refused) <= {"old", "repeated"}):
            reasons = "; ".join(f"{n} {REASONS[key]}" for key, n in flow.refused.most_common(3))
            problems.append(
                f"{100 * share:.0f} % of the poses are refused ({reasons}); expected at most"
                f" {100 * MOST_REFUSED:g} %"
            )
        return problems or self._times(flow)

    def _stamps(self, flow: Flow) -> list[str]:
        """Return the first problem of the stamps only, because others follow from it."""
        first, last, different = flow.stamps
        if "stamp" in flow.refused:
            return []
        if different == 1 and flow.count > 1:
            return [
                f"all {flow.count} stamps are {first:g} s: the sender does not stamp; expected the"
                " time of each measurement"
            ]
        if flow.backward > 0.5:
            return [
                f"stamps run backward, from {first:.3f} to {last:.3f} s; expected the time of each"
                " measurement"
            ]
        if abs(flow.drift) > MOST_DRIFT:
            return [
                f"stamps advance by {1.0 + flow.drift:.3g} s in a second; expected 1: another unit,"
                " or a clock that is set while it runs"
            ]
        return []

    def _times(self, flow: Flow) -> list[str]:
        """Return the problems of rate and regularity."""
        gate = self._gate
        estimate = self._estimate
        lowest = estimate.order / estimate.window
        highest = MOST_SAMPLES / estimate.window
        rate = flow.rate
        out = []
        if rate < lowest:
            out.append(
                f"{rate:.1f} good poses a second; expected {lowest:.0f} or more: the estimate's"
                f" window of {1e3 * estimate.window:g} ms holds {estimate.order + 1} then"
            )
        elif rate > highest:
            out.append(
                f"{rate:.0f} poses a second; expected {highest:.0f} at most: the estimate's"
                f" window of {1e3 * estimate.window:g} ms holds {MOST_SAMPLES}; let the source"
                " send fewer"
            )
        if flow.stale > MOST_STALE:
            out.append(
                f"poses are older than {1e3 * gate.warn:g} ms (gate.warn) for"
                f" {100 * flow.stale:.0f} % of the time, {1e3 * flow.gap:.0f} ms at most; expected"
                f" {100 * MOST_STALE:g} % or less:"
                + (" they come in bursts" if flow.close > MOST_CLOSE else " they come too rarely")
            )
        period = 1.0 / rate if rate else math.inf
        allowed = max(LEAST_SCATTER, SCATTER * period)
        if rate >= lowest and (flow.scatter > allowed or flow.bunched > MOST_CLOSE):
            out.append(
                f"stamps scatter by {1e3 * flow.scatter:.1f} ms, {100 * flow.bunched:.0f} % of them"
                f" are bunched; expected {1e3 * allowed:.1f} ms and {100 * MOST_CLOSE:g} %: stamp"
                " where the camera measures, not where it is forwarded"
            )
        if rate >= lowest and flow.transit > gate.warn:
            out.append(
                f"poses take {1e3 * flow.transit:.0f} ms longer at times; expected"
                f" {1e3 * gate.warn:g} ms at most: a cable in place of radio, or TIMESYNC"
            )
        return out


def _share_close(intervals: np.ndarray) -> float:
    """Return the share of intervals that are shorter than a quarter of their mean."""
    return float(np.mean(intervals < 0.25 * intervals.mean())) if len(intervals) else math.nan


def _scatter(intervals: np.ndarray) -> float:
    """Return the scatter of intervals about whole multiples of their median, which lost poses
    cause [s].
    """
    if not len(intervals):
        return math.nan
    period = float(np.median(intervals))
    if not period > 0.0:
        return math.inf
    deviation = intervals - np.maximum(np.round(intervals / period), 1.0) * period
    return float(np.sqrt(np.mean(deviation * deviation)))
