"""Times of each stage of a tick, as percentiles and histograms in memory that does not grow with
the run.
"""

import math
from pathlib import Path

import numpy as np

from hil.poses.pose import VEHICLE, Pose

STAGES = {
    "transport": (
        "from measurement to arrival; beyond the fastest pose where the source's clock is not known"
    ),
    "arrival": "from the newest pose's arrival to the tick",
    "late": "how late the tick began",
    "poll": "taking in what came since the last look",
    "estimate": "gate, filter, state machine",
    "observation": "projection and assembly of what the policy sees",
    "policy": "the network, and its output as a command",
    "send": "guard passed, until the bytes are with the system",
    "total": "from the look for messages to the command's bytes out",
    "ack": "from the release command to its answer",
}
"""Stage -> description, in the order of the report."""
OF_CLOCK = ("transport", "arrival", "late", "ack")
"""Stages measured by the run's clock, which ``--speed`` slows; the others are measured in real
time.
"""

SHORTEST = 1e-6  # lower edge of the first bin [s]
GROWTH = 1.01  # ratio of two edges: within 1 %
BINS = 1640  # up to 12 s
CLOCK_STEP = 0.3  # change of the offset of a source's clock that counts as a step [s]


class Stage:
    """A histogram of one stage's times in bins that grow by 1 %, with the exact maximum."""

    def __init__(self) -> None:
        self.counts = np.zeros(BINS, dtype=np.int64)
        self.most = 0.0

    def add(self, seconds: float) -> None:
        """Count one time [s]."""
        place = int(math.log(seconds / SHORTEST) / math.log(GROWTH)) if seconds > SHORTEST else 0
        self.counts[min(place, BINS - 1)] += 1
        self.most = max(self.most, seconds)

    def percentile(self, share: float) -> float:
        """Return the time [s] below which a share of all times lies, 0 to 1; accurate to 1 %, at
        most the maximum.
        """
        reached = np.searchsorted(np.cumsum(self.counts), share * self.counts.sum())
        return min(SHORTEST * GROWTH ** (float(reached) + 0.5), self.most)

    def summary(self) -> dict[str, float]:
        """Return p50, p95, p99 and max [ms] and the count; empty without times."""
        count = int(self.counts.sum())
        if not count:
            return {}
        shares = {"p50_ms": 0.5, "p95_ms": 0.95, "p99_ms": 0.99}
        return {
            **{k: 1e3 * self.percentile(p) for k, p in shares.items()},
            "max_ms": 1e3 * self.most,
            "count": count,
        }


class Stages:
    """All stages of a run."""

    def __init__(self) -> None:
        self.stages = {name: Stage() for name in STAGES}
        self._fastest: float | None = None

    def add(self, times: dict[str, float]) -> None:
        """Count the times of one tick [s], by stage."""
        for name, seconds in times.items():
            self.stages[name].add(seconds)

    def poses(self, poses: list[Pose], time: float) -> dict[str, float]:
        """Return the time from the newest arrival of a vehicle's pose to a tick at a time [s];
        count the transport time of each pose.
        """
        newest = None
        for pose in poses:
            if pose.body != VEHICLE or not (
                math.isfinite(pose.stamp) and math.isfinite(pose.arrival)
            ):
                continue
            newest = pose.arrival
            if pose.measured is not None:
                self.stages["transport"].add(pose.arrival - pose.measured)
                continue
            delay = pose.arrival - pose.stamp
            if self._fastest is None or abs(delay - self._fastest) > CLOCK_STEP:
                self._fastest = delay
            self._fastest = min(self._fastest, delay)
            self.stages["transport"].add(delay - self._fastest)
        return {} if newest is None else {"arrival": time - newest}

    def summary(self) -> dict[str, dict[str, float]]:
        """Return summaries by stage."""
        return {name: stage.summary() for name, stage in self.stages.items()}


def describe_clock(speed: float) -> str:
    """Return a note on the stages measured by the run's clock; empty if that is real time."""
    return (
        ""
        if speed == 1.0
        else f"; {', '.join(OF_CLOCK)}: by the run's clock, at {speed:g} of real time"
    )


def table(latency: dict[str, dict[str, float]], speed: float = 1.0) -> list[str]:
    """Return the lines of a report, one for each stage, from :meth:`Stages.summary` and the
    speed of the run's clock.
    """
    lines = [f"{'stage':11}     p50     p95     p99     max [ms]{describe_clock(speed)}"]
    for name, values in latency.items():
        if values:
            numbers = "".join(
                f" {values[k]:7.3f}" for k in ("p50_ms", "p95_ms", "p99_ms", "max_ms")
            )
            lines.append(f"{name:11}{numbers}   {STAGES.get(name, '')}")
    return lines


def draw(path: str | Path, stages: Stages, title: str) -> None:
    """Draw the share of each stage's times that exceed a given time, as a PNG file. Raises
    `StorageError`: it cannot be written.
    """
    from visthrow.common.storage import atomic_write
    from visthrow.view import style
    from visthrow.view.parts import png_of

    style.use()
    import matplotlib.pyplot as plt

    figure, axis = plt.subplots(figsize=(8.6, 6.0), layout="constrained")
    edges = 1e3 * SHORTEST * GROWTH ** np.arange(1, BINS + 1)  # [ms]
    counted = {name: stage for name, stage in stages.stages.items() if stage.counts.any()}
    for name, stage in counted.items():
        longer = 1.0 - np.cumsum(stage.counts) / stage.counts.sum()
        partial = (longer > 0.0) & (longer < 1.0)
        axis.step(edges[partial], longer[partial], label=f"{name}: {STAGES[name]}")
    axis.set(xscale="log", yscale="log", xlabel="time [ms]", ylabel="share that took longer")
    axis.set_title(title, loc="left", fontsize=11.5)
    if counted:
        figure.legend(loc="outside lower left", fontsize=8.0)
    atomic_write(path, png_of(figure))
