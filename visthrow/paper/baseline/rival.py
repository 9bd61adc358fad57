"""Throw with the baseline for ``visthrow compare``, at the policies' targets."""

import argparse
import tempfile

import piqp  # noqa: F401  needed by every worker: a missing package is an error at once

from visthrow.common.workers import status
from visthrow.paper.baseline import thrower
from visthrow.task.measurement import Entry, Throws
from visthrow.throws.reference_protocol import FIELDS


def throw_baseline(args: argparse.Namespace) -> list[Entry]:
    """Throw with trajectory optimisation and MPC, in the controller's model, and on the plant with
    each compensation of delays.
    """
    rows = thrower.rows([args.plant])
    how = {
        "config_name": args.config or "state",
        "overrides": args.overrides,
    }
    sets = [
        thrower.units(*row, target, args.throws, args.seed, **how)
        for row in rows
        for target in args.targets
    ]
    with tempfile.TemporaryDirectory() as folder:
        flights = thrower.fly_units(sets, folder, status)
    status("")
    throws = [
        Throws(flight.unit["target"], **{field: flight.columns[field] for field in FIELDS})
        for flight in flights
    ]
    targets = len(args.targets)
    layouts = ("TO+MPC" if plant == thrower.IDEAL else "" for plant, _ in rows)
    return [
        Entry(thrower.title_of(*row), layout, throws[i * targets : (i + 1) * targets])
        for i, (row, layout) in enumerate(zip(rows, layouts))
    ]
