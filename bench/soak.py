"""The soak of ``bench.runner``: a throw that lasts, as a run flies it."""

import argparse
import dataclasses
import json
import os
import shutil
import sys
import tempfile
from pathlib import Path

import numpy as np

from bench.processes import Memory, Pair
from bench.report import Report, Table
from visthrow.common.errors import VisthrowError

STILL = ("--plant", "tests.level:make")
"""A vehicle without a simulator, which takes no time from the runner."""

P50 = 1.2
P99 = 2.2
"""Limits on the time from reading messages to the command's bytes [ms]."""

WARM = 0.2
"""Share of a soak before memory is looked at: buffers fill, pages are touched."""

TELL = 30.0
"""Time between two progress messages [s]."""

TIMES = ("p50_ms", "p95_ms", "p99_ms", "max_ms")


class Progress(Memory):
    """Memory over time, printed and appended to a file during the soak."""

    def __init__(self, path: Path, minutes: float) -> None:
        """Begin the file; ``minutes``: length of the soak."""
        super().__init__()
        self._path = path
        self._minutes = minutes
        self._written_at = -TELL
        path.parent.mkdir(parents=True, exist_ok=True)
        path.unlink(missing_ok=True)

    @property
    def seconds(self) -> float:
        """Watched so far [s]."""
        return self.samples[-1][0] - self.samples[0][0] if self.samples else 0.0

    def __call__(self, pid: int) -> None:
        """See `Memory`."""
        super().__call__(pid)
        if self.samples and self.seconds >= self._written_at + TELL:
            self._written_at = self.seconds
            with self._path.open("a", encoding="utf-8") as file:
                file.write(
                    json.dumps({"seconds": self.seconds, "memory_bytes": self.samples[-1][1]})
                    + "\n"
                )
            print(
                f"{self.seconds / 60:.1f} of {self._minutes:g} minutes,"
                f" {self.samples[-1][1] / 1e6:.1f} MB",
                file=sys.stderr,
            )


def soak(args: argparse.Namespace) -> Report:
    """Latency, misses and memory of a long throw; Ctrl-C ends it early with a report of the time so
    far.

    Raises:
        VisthrowError: a time or rate out of range.
    """
    if not (args.minutes > 0.0 and 1.0 <= args.rate <= 1000.0):
        raise VisthrowError(
            f"--minutes {args.minutes}, --rate {args.rate}; expected above 0, and 1 to 1000 Hz"
        )
    progress = Progress(Path(args.out) / "soak.jsonl", args.minutes)
    with tempfile.TemporaryDirectory() as folder:
        place = Path(folder)
        policy = never_releasing(args.policy, place / "policy.npz")
        run = (
            "--set",
            f'policy="{policy}"',
            "--set",
            "states.throw=1e6",
            "--set",
            "states.abort=0.5",
        )

        fake = (*STILL, "--rate", str(args.rate), "--seconds", str(60.0 * args.minutes))
        summary, report = Pair(run, fake, args.core, _another(args.core), orderly=True).fly(
            place / "run", progress
        )
        size = sum(path.stat().st_size for path in (place / "run").iterdir())
        if args.keep is not None:
            shutil.copytree(place / "run", args.keep)
    if not summary["latency"].get("total"):
        raise VisthrowError(f"no command was ever sent: {summary['reason']}")
    return _report(summary, report, progress, size, args)


def _another(core: int | None) -> int | None:
    """A core for the fake beside that of the run; None where the system chooses, or has
    no other.
    """
    if core is None or not hasattr(os, "sched_getaffinity"):
        return None
    return next((other for other in sorted(os.sched_getaffinity(0)) if other != core), None)


def never_releasing(name: str, path: Path) -> Path:
    """Write a copy of a policy that never releases, for a throw that does not end.

    Args:
        name: of a shipped policy, or a file. path: to write.
    """
    from visthrow.onboard.policy import Policy, find_policy

    policy = Policy.load(find_policy(name))
    weights = policy.weights[-1].clone()
    biases = policy.biases[-1].clone()
    weights[-1] = 0.0
    biases[-1] = -1.0
    changed = {"weights": (*policy.weights[:-1], weights), "biases": (*policy.biases[:-1], biases)}
    dataclasses.replace(policy, **changed).save(path)
    return path


def slope(samples: list[tuple[float, float]]) -> float | None:
    """Growth of memory [bytes/s] by a line through what followed the first share of the time; None
    with too few samples.
    """
    if len(samples) < 10:
        return None
    time, size = np.array(samples).T
    late = time - time[0] >= WARM * (time[-1] - time[0])
    return float(np.polyfit(time[late] - time[0], size[late], 1)[0])


def _stages(latency: dict[str, dict[str, float]], title: str) -> Table:
    rows = [
        (name, *(f"{v[key]:.3f}" for key in TIMES), f"{v['count']:,}")
        for name, v in latency.items()
        if v
    ]
    return Table(title, ("stage", "p50", "p95", "p99", "max", "count"), tuple(rows))


def _report(
    summary: dict, report: dict, progress: Progress, size: int, args: argparse.Namespace
) -> Report:
    grown = slope(progress.samples)
    samples = progress.samples
    early = summary["interrupted"]
    seconds = progress.seconds if early else 60.0 * args.minutes
    ends = [f"{s / 1e6:.1f} MB" for _, s in (samples[0], samples[-1])] if samples else ["?", "?"]
    counts = (
        ("ticks", f"{summary['ticks']:,}"),
        ("missed", str(summary["missed"])),
        ("missed because a tick of ours took too long", str(summary["missed_ours"])),
        ("commands that the fake took", f"{report['commands']:,}"),
        ("breaches it noted", str(len(report["breaches"]))),
        ("memory at the start and at the end", " and ".join(ends)),
        (
            "growth after the first fifth",
            "not known" if grown is None else f"{grown * 60 / 1e3:+.1f} kB a minute",
        ),
        ("recorded", f"{size / 1e6:.1f} MB"),
    )
    figures = {
        "latency_ms": summary["latency"],
        "ticks": summary["ticks"],
        "missed": summary["missed"],
        "missed_ours": summary["missed_ours"],
        "worst_late_s": summary["worst_late_s"],
        "seconds": seconds,
        "interrupted": early,
        "rate_hz": args.rate,
        "memory_bytes_per_s": grown,
        "memory_bytes": [s for _, s in samples[:: max(1, len(samples) // 200)]],
        "breaches": report["breaches"],
        "recorded_bytes": size,
    }
    tables = (
        _stages(summary["latency"], "Times of each stage [ms]"),
        Table("The run", ("what", "measured"), counts),
    )
    title = f"HIL runner over loopback: {seconds:.0f} s in real time, poses at {args.rate:g} Hz"
    return Report("hil", title, tables, _notes(summary, early, seconds, args), figures)


def _notes(summary: dict, early: bool, seconds: float, args: argparse.Namespace) -> tuple[str, ...]:
    total = summary["latency"]["total"]
    verdict = "within" if total["p50_ms"] < P50 and total["p99_ms"] < P99 else "NOT within"
    notes = (
        (
            "total, from the look for messages to the command's bytes out: p50"
            f" {total['p50_ms']:.3f} ms and p99 {total['p99_ms']:.3f} ms, {verdict} the bars of"
            f" {P50} and {P99} ms"
        ),
        (
            f"policy '{args.policy}' in a throw that it never ends, every tick: gate, filter, state"
            " machine, projection, network, guard, link, recording to disk; the fake autopilot and"
            " its motion capture in a process of their own, UDP on loopback"
        ),
        (
            "the run is kept on one core"
            if args.core is not None
            else "the system chooses the cores; --core N keeps the run on one"
        ),
        (
            "a missed tick counts as ours where the tick before it was not done when it was due,"
            " for whatever reason"
        ),
    )
    return (
        (*notes, f"INTERRUPTED after {seconds:.0f} of {60 * args.minutes:.0f} s")
        if early
        else notes
    )
