"""Export a flight for other programs.

python examples/export_flight.py out/fly/flight.npz --to flight.csv
"""

import argparse

from visthrow.logs.export import export
from visthrow.logs.flightlog import FlightLog


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("flight")
    parser.add_argument("--to", default="flight.csv", help="a file; the ending is the format")
    args = parser.parse_args()
    log = FlightLog.load(args.flight)
    export(log, args.to)
    print(f"{args.to}: {len(log.channels)} channels of {log.meta['policy']}")


if __name__ == "__main__":
    main()
