"""Fly one throw with a policy file and print where the ball landed.

python examples/fly_mine.py runs/mine/policy.npz --target 1.5
"""

import argparse

import numpy as np

from visthrow.throws.loading import load_policy
from visthrow.throws.recorded import fly


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("policy", help="a file, or the name of a shipped policy")
    parser.add_argument("--target", type=float, default=1.5, help="distance of the goal [m]")
    parser.add_argument("--seed", type=int, default=0, help="of start, plant and measurements")
    parser.add_argument("--out", default="flight.npz")
    args = parser.parse_args()
    log = fly(load_policy(args.policy), np.array([args.target, 0.0, 0.0]), seed=args.seed)
    log.save(args.out)
    result = log.meta["result"]
    landed = f"landed {result['error']:.3f} m from the goal" if "error" in result else "not landed"
    print(f"{args.out}: {landed}; released {log.meta['times']['latch']} s after the start")


if __name__ == "__main__":
    main()
