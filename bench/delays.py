"""Hold stated deviations of delays against delays that were put in (python -m bench.delays)."""

import argparse
import sys
from typing import Any

import numpy as np
from scipy.signal import lfilter

from bench import start
from bench.report import Report, Table, finish
from visthrow.logs.check.relations import REACH, relate
from visthrow.logs.samples import Samples

KINDS = ("slow", "fast", "noisy", "crash")


def draw_motion(seed: int, kind: str, together: bool = False) -> tuple[np.ndarray, ...]:
    """Draw a motion and the velocity that a log holds of it.

    Returns times [s], positions [m], velocities [m/s], and how late the velocity is [s]; noise is
    white or coloured, a crash ends in a second of tumbling.

    Args:
        seed: Of the draw.
        kind: One of :data:`KINDS`.
        together: Whether both are fields of one message, on one clock.
    """
    rng = np.random.default_rng([seed, KINDS.index(kind)])
    time = np.arange(0.0, rng.uniform(12.0, 40.0), rng.choice([0.01, 0.02]))
    frequency = rng.uniform(*((0.02, 0.15) if kind == "slow" else (0.1, 1.5)), (6, 3))
    size = 0.1 * rng.uniform(0.02, 0.5, (6, 3)) / frequency
    phase = rng.uniform(0.0, 6.28, (6, 3))
    late = 0.0 if together else rng.uniform(-0.1, 0.1)
    turn = 2.0 * np.pi * frequency
    pos = np.sum(size * np.sin(turn * time[:, None, None] + phase), axis=1)
    vel = np.sum(size * turn * np.cos(turn * (time - late)[:, None, None] + phase), axis=1)
    share = {"slow": 0.2, "fast": 0.05, "noisy": 1.0, "crash": 0.1}[kind] * rng.uniform(0.2, 1.0)
    noise = rng.normal(0.0, share * np.std(vel), vel.shape)
    if rng.random() < 0.5:
        decay = np.exp(-(time[1] - time[0]) / rng.uniform(0.02, 0.5))
        noise = lfilter([np.sqrt(1.0 - decay**2)], [1.0, -decay], noise, axis=0)
    vel = vel + noise
    pos = pos + rng.normal(0.0, 10.0 ** rng.uniform(-4.3, -3.0), pos.shape)
    if kind == "crash":
        last = np.maximum(time - time[-1] + 1.0, 0.0)[:, None]
        vel = vel + last * np.std(vel) * rng.normal(0.0, 15.0, 3)
        pos = pos + last**2 * np.std(vel) * rng.normal(0.0, 5.0, 3)
    return time, pos, vel, np.float64(late)


def measure(seed: int, kind: str, together: bool = False) -> tuple[float, float]:
    """Return the error of a delay and its stated deviation [s]."""
    time, pos, vel, late = draw_motion(seed, kind, together)
    relation = relate(Samples(time, pos).derivative(), Samples(time, vel))
    assert relation is not None
    return relation.delay - float(late), relation.delay_sd


def run(args: argparse.Namespace) -> int:
    """Draw, measure, print."""
    rows = []
    figures: dict[str, Any] = {}
    for together in (False, True):
        for kind in KINDS:
            seeds = range(args.seed, args.seed + args.cases // len(KINDS))
            pairs = np.array([measure(seed, kind, together) for seed in seeds])
            errors, deviations = np.abs(pairs.T)
            stated = deviations < 0.9 * REACH
            held = float(np.mean(errors < 1.96 * deviations))
            held_stated = float(np.mean((errors < 1.96 * deviations)[stated]))
            name = f"{kind}, {'one message' if together else 'put in'}"
            middle = 1e3 * float(np.median(deviations[stated]))
            figures[name] = {
                "cases": len(pairs),
                "held": held,
                "stated": float(np.mean(stated)),
                "held_stated": held_stated,
                "deviation_ms": middle,
            }
            rows.append(
                (name, *(f"{100 * x:.0f} %" for x in (held, np.mean(stated), held_stated)))
                + (f"{middle:.1f} ms",)
            )
    every = [figures[name] for name in figures if "put in" in name]
    total = float(np.mean([figure["held"] for figure in every]))
    figures["held"] = total
    header = ("motion", "truths held", "a delay is stated", "of these held", "median deviation")
    notes = (
        f"Of {args.cases} delays that were put in, {100 * total:.1f} % lie within 1.96 deviations.",
        "Where slow motion or noise hides a delay, it is not stated: its deviation is the reach of"
        f" the search, {REACH} s.",
    )
    title = "Deviations of delays"
    table = Table(title, header, tuple(rows))
    return finish(Report("delays", title, (table,), notes, figures), args)


def main(argv: list[str] | None = None) -> int:
    """Measure from the command line."""
    parser = start.parser_of(__doc__)
    parser.add_argument("--seed", type=int, default=0, help="first of the seeds")
    parser.add_argument("--cases", type=int, default=200, help="delays of each half")
    return start.main(parser, run, argv)


if __name__ == "__main__":
    sys.exit(main())
