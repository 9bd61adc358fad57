"""``visthrow bench hil``: the runner against the fake autopilot, each in its own process, over loopback in real time.

Latency and soak by default: times of each stage, ticks missed, memory. With ``--throws`` a series of throws, each paired with
the same one flown without a wire. With ``--faults`` what the runner does when something fails, and after how long.
"""

import argparse

from visthrow.evidence.bench.records import finish


def run(args: argparse.Namespace) -> int:
    """Measure what was asked for."""
    if args.throws:
        from visthrow.evidence.bench.hil.throws import series

        return finish(series(args), args)
    if args.faults is not None:
        from visthrow.evidence.bench.hil.faults import faults

        return finish(faults(args), args)
    from visthrow.evidence.bench.hil.soak import soak

    return finish(soak(args), args)
