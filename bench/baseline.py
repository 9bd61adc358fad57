"""The baseline's throws behind the report: flies those that no record holds, and rewrites the
record.
"""

import argparse
import importlib
import sys
from collections.abc import Iterator, Sequence
from pathlib import Path
from typing import Any

from bench import start
from visthrow.paper import RECORDS, results
from visthrow.paper.baseline import front, thrower
from visthrow.paper.baseline.front import FRONT_TARGET, FRONT_THROWS
from visthrow.paper.baseline.thrower import BOUNDS
from visthrow.task.measurement import TARGETS


def list_units() -> list[dict[str, Any]]:
    """Units of the committed record ``baseline``: the cheap and informative ones first."""
    made_up = [*_list_front(), *_list_on_reference("both", 20, front.SPEEDS[1::2])]
    return [
        *_list_by_target(50),
        *made_up,
        *_list_late_front(),
        *_list_on_reference("delay", 20, front.SPEEDS[1:2]),
    ]


def _list_by_target(throws: int) -> Iterator[dict[str, Any]]:
    for target in TARGETS:
        yield from thrower.units(thrower.IDEAL, "none", target, throws)
    for compensation in reversed(thrower.COMPENSATIONS):
        for target in TARGETS:
            yield from thrower.units("hybrid", compensation, target, throws)


def _settings(speeds: tuple[float, ...] = front.SPEEDS) -> Iterator[dict[str, float]]:
    for speed in speeds:
        for w_t, rho in front.WEIGHTS:
            yield {"speed": speed, "w_t": w_t, "rho": rho}


def _list_front() -> Iterator[dict[str, Any]]:
    """The sweep in the baseline's model and, with all delays compensated, in the training
    simulator.
    """
    for bounds in BOUNDS[::-1]:
        for how in _settings():
            yield from thrower.units(
                thrower.IDEAL, "none", FRONT_TARGET, FRONT_THROWS, bounds=bounds, **how
            )
            yield from thrower.units(
                "hybrid", "both", FRONT_TARGET, FRONT_THROWS, bounds=bounds, **how
            )


def _list_late_front() -> Iterator[dict[str, Any]]:
    """The sweep without compensation of the release's lag."""
    for how in _settings():
        yield from thrower.units("hybrid", "delay", FRONT_TARGET, FRONT_THROWS, **how)


def _list_on_reference(
    compensation: str, throws: int, speeds: tuple[float, ...]
) -> Iterator[dict[str, Any]]:
    """By target and a part of the sweep: a throw takes seconds there."""
    for target in (FRONT_TARGET, *(target for target in TARGETS if target != FRONT_TARGET)):
        yield from thrower.units("reference-realistic", compensation, target, throws)
    for how in _settings(speeds):
        yield from thrower.units(
            "reference-realistic", compensation, FRONT_TARGET, FRONT_THROWS, **how
        )


def run(args: argparse.Namespace) -> int:
    """Fly and write."""
    importlib.import_module("piqp")  # a missing package is reported once, not by every worker
    path = Path(args.records) / "throws" / "baseline.json"
    known = results.load_all([path])
    units = results.work(
        list_units(),
        args.out,
        thrower.fly_unit,
        known,
        args.jobs,
        lambda text: print(text, file=sys.stderr, flush=True),
    )
    results.pack(units.values(), path)
    print(path)
    return 0


def main(argv: Sequence[str] | None = None) -> int:
    """Run the command."""
    parser = start.parser_of(__doc__, record=False)
    parser.add_argument(
        "--records",
        metavar="FOLDER",
        default=str(RECORDS),
        help="of records (default: the package's)",
    )
    parser.add_argument(
        "--out",
        metavar="FOLDER",
        default="out/baseline/throws",
        help="of what is flown, to go on with",
    )
    parser.add_argument(
        "--jobs", type=int, default=1, metavar="N", help="processes at once (default: 1)"
    )
    return start.main(parser, run, argv)


if __name__ == "__main__":
    sys.exit(main())
