"""Compare policies on the simulator that trained them and on an independent one.

    python examples/compare_plants.py state vision --throws 20

The second plant needs `pip install 'visthrow[reference]'`.
"""

import argparse

import visthrow


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("policies", nargs="+", help="files, or names of shipped policies")
    parser.add_argument("--throws", type=int, default=20, help="for each policy and plant")
    parser.add_argument("--plants", nargs="+", default=["hybrid", "reference"])
    args = parser.parse_args()
    for plant in args.plants:
        figures = visthrow.compare(
            *args.policies, plant=plant, throws=args.throws, targets=[2.0], out="out/compare"
        )
        for row in figures["rows"]:
            error = row.get("error_mean", float("nan"))
            print(f"{plant:10} {row['policy']:8} {error:.3f} m, {row['success']:.0%} landed")


if __name__ == "__main__":
    main()
