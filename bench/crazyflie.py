"""Throws of a whole runner at a Crazyflie by its firmware's source (`FakeCrazyflie`), lock step.

python -m bench.crazyflie --throws 60
python -m bench.crazyflie --throws 3 --yaw -1    # yaw commanded the other way round
"""

import argparse
import math
from typing import Any

import numpy as np

from hil.links import crtp
from tests.loopback.wire import throw
from visthrow.throws.wire_plant import make

GOAL = 2.0  # distance [m]
LONGEST = 11.0  # time of a run in which the payload lands [s]
POLICY = "vision"


def fly(seed: int, yaw: int = 1) -> tuple[float | None, dict[str, Any], Any]:
    """Fly one throw; returns the landing's distance from the goal [m], the summary, and the fake.

    Args:
        seed: of start, noise and loss. yaw: -1 turns the sign of the yaw rate that is sent.
    """
    sent = crtp.manual
    crtp.manual = lambda thrust, rates: sent(thrust, (rates[0], rates[1], yaw * rates[2]))
    try:
        summary, fake, _ = throw(
            make(POLICY, seed), kind="crazyflie", policy=POLICY, seed=seed, seconds=LONGEST
        )
    finally:
        crtp.manual = sent
    landing = fake.plant.landing["landing_w"]
    off = None if landing is None else math.hypot(landing[0] - GOAL, landing[1])
    return off, summary, fake


def main() -> None:
    """Fly throws; a line each, then the count and the mean."""
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("--throws", type=int, default=60, metavar="N")
    parser.add_argument("--first", type=int, default=0, metavar="SEED")
    parser.add_argument("--yaw", type=int, choices=(1, -1), default=1, help="-1: turned")
    args = parser.parse_args()
    errors = []
    for seed in range(args.first, args.first + args.throws):
        off, summary, fake = fly(seed, args.yaw)
        errors += [] if off is None else [off]
        outcome = "not landed" if off is None else f"{off:.3f} m"
        breaches = f"; {fake.witness.breaches}" if fake.witness.breaches else ""
        print(f"seed {seed}: {outcome}; {summary['reason']}{breaches}", flush=True)
    print(f"{len(errors)} of {args.throws} landed", end="")
    if errors:
        print(f"; {np.mean(errors):.4f} m in the mean, {max(errors):.3f} m at most", end="")
    print()


if __name__ == "__main__":
    main()
