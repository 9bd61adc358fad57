"""One real-time iteration of the baseline's controller, and how closely it follows its plan."""

import argparse
import sys
from collections.abc import Sequence

import numpy as np

from bench import start
from bench.common_options import add_common
from bench.report import Report, Table, finish
from bench.sim import pin_to_one_core
from visthrow.common.errors import VisthrowError

TARGETS = (1.5, 2.0, 2.5)
LIMIT_MS = 10.0
"""Limit on the time of a step, half of a control period [ms]."""


def run(args: argparse.Namespace) -> int:
    """Fly plans and time every step of the controller."""
    if args.throws < 1:
        raise VisthrowError(f"--throws {args.throws}; expected 1 or more")
    from visthrow.task import load_experiment

    experiment = load_experiment(args.config, args.overrides)
    with pin_to_one_core(args.core) as core:
        report = measure(experiment, args.throws, core)
    return finish(report, args)


def measure(experiment, throws: int, core: int | None = None) -> Report:
    """Time the controller in its own model and on the training simulator.

    Args:
        experiment: whose plant it is.
        throws: a target and plant.
        core: that the process stays on, for the note.
    """
    from visthrow.paper.baseline import fly_plan as fly
    from visthrow.paper.baseline import thrower

    rows = []
    figures = []
    for target in TARGETS:
        unit = thrower.unit("hybrid", "both", target, throws)
        plan = thrower.plan_of(experiment, unit)
        delays = fly.delays_of(experiment, "both")
        for plant, name in (("pendulum", "own model"), ("hybrid", "training simulator")):
            if plant == "pendulum":
                flown = fly.fly_pendulum(plan, throws, 0)
            else:
                flown = fly.fly_plant(plan, plant, experiment, delays, throws, 0)
            times = 1e3 * flown.step_times
            off = 100.0 * flown.tracking[flown.success]
            figure = {
                "target": target,
                "plant": plant,
                "steps": len(times),
                "p50_ms": float(np.percentile(times, 50)),
                "p99_ms": float(np.percentile(times, 99)),
                "max_ms": float(times.max()),
                "share_over_limit": float((times > LIMIT_MS).mean()),
                "landed": float(flown.success.mean()),
                "tracking_cm": float(off.mean()) if len(off) else None,
            }
            figures.append(figure)
            cells = (f"{figure[key]:.2f}" for key in ("p50_ms", "p99_ms", "max_ms"))
            tracking = "-" if figure["tracking_cm"] is None else f"{figure['tracking_cm']:.1f}"
            rows.append((f"{target:g} m", name, str(len(times)), *cells, tracking))
    head = (
        "target",
        "flown in",
        "steps",
        "p50 [ms]",
        "p99 [ms]",
        "longest [ms]",
        "off the plan, RMS [cm]",
    )
    notes = (
        (
            "One step: linearise 62 stages, fill and solve the quadratic programme (piqp), move"
            f" on; {throws} throws a row."
        ),
        (
            "The programme is set up once, before the throw, and is not part of a step. On the"
            " training simulator all known delays are made up for, by looking ahead; that is not"
            " part of a step either."
        ),
        (
            f"Measured on one core{'' if core is None else f', number {core}'}; a step was to stay"
            f" under {LIMIT_MS:g} ms at p99."
        ),
    )
    table = Table("Step times", head, tuple(rows))
    return Report(
        "mpc", "Step of the model-predictive controller", (table,), notes, {"rows": figures}
    )


def main(argv: Sequence[str] | None = None) -> int:
    """Run the command."""
    parser = start.parser_of(__doc__)
    parser.add_argument(
        "--throws", type=int, default=10, metavar="N", help="a target and plant (default: 10)"
    )
    parser.add_argument(
        "--core", type=int, metavar="N", help="CPU core to stay on (default: the last one)"
    )
    parser.add_argument(
        "--config",
        default="state",
        metavar="NAME",
        help="of configs/train: whose plant it is (default: state)",
    )
    add_common(parser, device=False, json=False)
    return start.main(parser, run, argv)


if __name__ == "__main__":
    sys.exit(main())
