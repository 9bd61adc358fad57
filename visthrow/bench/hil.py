"""``visthrow bench hil``: the runner against the fake autopilot, each in its own process, over loopback in real time.

Latency and soak by default: times of each stage, ticks missed, memory. With ``--throws`` a series of throws, each paired with
the same one flown without a wire. With ``--faults`` what the runner does when something fails, and after how long.
"""

import argparse
import dataclasses
import json
import math
import shutil
import tempfile
from pathlib import Path
from typing import Any

import numpy as np

from visthrow.bench.hil_processes import Memory, Pair
from visthrow.bench.records import Report, Table, finish
from visthrow.errors import VisthrowError

STILL = ("--plant", "hil.fakes.level:make")
"""A vehicle without a simulator: it takes no time from the runner."""

P50, P99 = 0.5, 1.5
"""Bars of the whole way from the look for messages to the command's bytes [ms]."""

WARM = 0.2
"""Share of a soak before memory is looked at: buffers fill, pages are touched."""


def run(args: argparse.Namespace) -> int:
    """Measure what was asked for."""
    if args.throws:
        from visthrow.bench.hil_throws import series

        return finish(series(args), args)
    if args.faults is not None:
        from visthrow.bench.hil_faults import faults

        return finish(faults(args), args)
    return finish(soak(args), args)


def soak(args: argparse.Namespace) -> Report:
    """Latency, misses and memory of a throw that lasts.

    Raises:
        VisthrowError: a time or rate out of range.
    """
    if not (args.minutes > 0.0 and 1.0 <= args.rate <= 1000.0):
        raise VisthrowError(f"--minutes {args.minutes}, --rate {args.rate}; expected above 0, and 1 to 1000 Hz")
    seconds, memory = 60.0 * args.minutes, Memory()
    with tempfile.TemporaryDirectory() as folder:
        policy = never_releasing(args.policy, Path(folder) / "policy.npz")
        run = ("--config", "fake", "--set", f'policy="{policy}"', "--set", "states.throw=1e6", "--set", "states.abort=0.5")
        fake = (*STILL, "--rate", str(args.rate), "--seconds", str(seconds))
        summary, report = Pair(run, fake, args.core).fly(Path(folder) / "run", memory)
        size = sum(path.stat().st_size for path in (Path(folder) / "run").iterdir())
        if args.keep is not None:
            shutil.copytree(Path(folder) / "run", args.keep)
    return _soaked(summary, report, memory, seconds, size, args)


def never_releasing(name: str, path: Path) -> Path:
    """Write a policy that is another one in all but its release, which it never asks for: a throw that lasts.

    Args:
        name: of a shipped policy, or a file. path: to write.
    """
    from visthrow.policy import Policy, find_policy

    policy = Policy.load(find_policy(name))
    weights, biases = policy.weights[-1].clone(), policy.biases[-1].clone()
    weights[-1], biases[-1] = 0.0, -1.0
    changed = {"weights": (*policy.weights[:-1], weights), "biases": (*policy.biases[:-1], biases)}
    dataclasses.replace(policy, **changed).save(path)
    return path


def slope(samples: list[tuple[float, float]]) -> float | None:
    """Growth of memory [bytes/s] by a line through what followed the first share of the time; None with too few samples."""
    if len(samples) < 10:
        return None
    time, size = np.array(samples).T
    late = time - time[0] >= WARM * (time[-1] - time[0])
    return float(np.polyfit(time[late] - time[0], size[late], 1)[0])


def _soaked(summary: dict, report: dict, memory: Memory, seconds: float, size: int, args: Any) -> Report:
    rows = [
        (name, *(f"{values[key]:.3f}" for key in ("p50_ms", "p95_ms", "p99_ms", "max_ms")), f"{values['count']:,}")
        for name, values in summary["latency"].items()
        if values
    ]
    grown = slope(memory.samples)
    total = summary["latency"].get("total") or {}
    if not total:
        raise VisthrowError(f"no command was ever sent: {summary['reason']}")
    ends = [f"{s / 1e6:.1f} MB" for _, s in (memory.samples[0], memory.samples[-1])] if memory.samples else ["?", "?"]
    counts = (
        ("ticks", f"{summary['ticks']:,}"),
        ("missed", str(summary["missed"])),
        ("missed because a tick of ours took too long", str(summary["missed_ours"])),
        ("commands that the fake took", f"{report['commands']:,}"),
        ("breaches it noted", str(len(report["breaches"]))),
        ("memory at the start and at the end", " and ".join(ends)),
        ("growth after the first fifth", "not known" if grown is None else f"{grown * 60 / 1e3:+.1f} kB a minute"),
        ("recorded", f"{size / 1e6:.1f} MB"),
    )
    figures = {
        "latency_ms": summary["latency"], "ticks": summary["ticks"], "missed": summary["missed"],
        "missed_ours": summary["missed_ours"], "worst_late_s": summary["worst_late_s"], "seconds": seconds,
        "rate_hz": args.rate, "memory_bytes_per_s": grown,
        "memory_bytes": [s for _, s in memory.samples[:: max(1, len(memory.samples) // 200)]],
        "breaches": report["breaches"], "recorded_bytes": size,
    }  # fmt: skip
    verdict = "within" if total["p50_ms"] < P50 and total["p99_ms"] < P99 else "NOT within"
    notes = (
        f"total, from the look for messages to the command's bytes out: p50 {total['p50_ms']:.3f} ms and "
        f"p99 {total['p99_ms']:.3f} ms, {verdict} the bars of {P50} and {P99} ms",
        f"policy '{args.policy}' in a throw that it never ends, every tick: gate, filter, state machine, projection, network, "
        "guard, link, recording to disk; the fake autopilot and its motion capture in a process of their own, UDP on loopback",
        "the run is kept on one core" if args.core is not None else "the system chooses the cores",
        "a missed tick counts as ours where the tick before it was not done when it was due, for whatever reason",
    )
    title = f"HIL runner over loopback: {seconds:g} s in real time, poses at {args.rate:g} Hz"
    stages = Table("Times of each stage [ms]", ("stage", "p50", "p95", "p99", "max", "count"), tuple(rows))
    return Report("hil", title, (stages, Table("The run", ("what", "measured"), counts)), notes, figures)


def bootstrap_upper(ratio_of: np.ndarray, level: float = 0.9, draws: int = 20_000, seed: int = 0) -> tuple[float, float]:
    """Ratio of the means of two columns of pairs, and the one-sided upper bound of it by drawing pairs anew.

    Args:
        ratio_of: shape (N, 2).
        level: of the bound.
        draws: bootstrap samples. seed: of them.
    """
    rng = np.random.default_rng(seed)
    means = ratio_of[rng.integers(len(ratio_of), size=(draws, len(ratio_of)))].mean(axis=1)
    value = float(ratio_of[:, 0].mean() / ratio_of[:, 1].mean())
    return value, float(np.quantile(means[:, 0] / means[:, 1], level))


def json_lines(path: Path) -> list[dict[str, Any]]:
    """Values of a file of lines; a last one that was cut short is left out, and so is a file that is not there."""
    found = []
    for row in path.read_text(encoding="utf-8").splitlines() if path.is_file() else ():
        try:
            found.append(json.loads(row))
        except ValueError:
            break
    return found


def finite(value: float | None) -> bool:
    """Whether a figure is there and a number."""
    return value is not None and math.isfinite(value)
