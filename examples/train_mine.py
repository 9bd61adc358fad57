"""Train a policy for a heavier ball on a longer rope, and throw with it.

python examples/train_mine.py --minutes 30 --out runs/mine
"""

import argparse
from pathlib import Path

import visthrow

CHANGES = {"rope.length": 0.45, "rope.payload_mass": 0.08}  # [m], [kg]


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--minutes", type=float, default=30.0, help="of training")
    parser.add_argument("--environments", type=int, default=1024, help="simulated side by side")
    parser.add_argument("--out", type=Path, default=Path("runs/mine"))
    args = parser.parse_args()
    settings = {**CHANGES, "ppo.environments": args.environments}
    visthrow.train("laptop", minutes=args.minutes, set=settings, device="cpu", out=args.out)
    policy = args.out / "policy.npz"
    figures = visthrow.compare(policy, throws=10, targets=[1.5], device="cpu", out=args.out)
    for row in figures["rows"]:
        print(f"{policy}: {row['success']:.0%} of {row['throws']} throws landed")


if __name__ == "__main__":
    main()
