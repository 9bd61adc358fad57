"""Throw the load of a pair in two halves, one after the other, beside the pair's own throws.

Each half hangs as a ball on a rope of the pair's length below one vehicle of the pair, flown by the
policy for any vehicle; the second vehicle begins as the first half lands."""

import argparse
from collections.abc import Sequence
from typing import Any

import numpy as np

from bench import start
from visthrow.common.arguments import ABOVE_ZERO, WHOLE


def main(argv: Sequence[str] | None = None) -> int:
    """Entry point; returns the exit status."""
    parser = start.parser_of(__doc__, record=False)
    parser.add_argument("--policy", default="any", help="of a single vehicle (default: any)")
    parser.add_argument("--target", type=ABOVE_ZERO, default=2.0, help="along x [m] (default: 2)")
    parser.add_argument("--throws", type=WHOLE, default=200, help="of the load (default: 200)")
    parser.add_argument("--seed", type=WHOLE, default=0, help="of starts and noise (default: 0)")
    parser.add_argument("--json", metavar="FILE", help="write the printed figures to this file too")
    return start.main(parser, run, argv)


def run(args: argparse.Namespace) -> None:
    """Throw both ways and print a table."""
    from visthrow.common.storage import write_json
    from visthrow.cooperative.team_command import load
    from visthrow.cooperative.team_training import throw
    from visthrow.view.parts import align

    experiment, policy, _ = load("pair", "tree")
    options = {"target": args.target, "count": args.throws, "seed": args.seed}
    row = throw(experiment, policy.act, **options)
    rows = [{"way": "both vehicles at once: pair", **row}, halves(args, experiment.rope)]
    heads = ("way", "throws", "mean error [m]", "95 % [m]", "until all has landed [s]", "landed")
    print(align(heads, [cells(row) for row in rows], heads=1))
    if args.json:
        write_json(args.json, rows)


def halves(args: argparse.Namespace, rope: Any) -> dict[str, Any]:
    """Figures of throws in halves: errors of each half, time from the first start to the second
    landing; ``rope`` is the pair's.
    """
    from visthrow.throws.loading import load_policy
    from visthrow.training.protocol import throw

    ball = {"payload_offset": rope.payload_radius}
    ball["payload_inertia"] = 2.0 / 3.0 * rope.payload_mass * rope.payload_radius**2
    for name in ("length", "rope_mass", "payload_mass", "payload_radius"):
        ball[name] = getattr(rope, name)
    changes = [f"rope.{name}={value}" for name, value in ball.items()]
    changes.append(f"camera.payload_radius={rope.payload_radius}")
    single = load_policy(args.policy, overrides=changes)
    count = 2 * args.throws
    actor = single.policy.actor(count)
    throws = throw(single.experiment, actor, args.target, count, "cpu", args.seed)
    error = throws.error[throws.success]
    return {
        "way": f"in halves, one after the other: {single.name}",
        "throws": args.throws,
        "error_mean": float(error.mean()),
        "error_p95": float(np.quantile(error, 0.95)),
        "duration_mean": float(np.nanmean(throws.duration.reshape(2, -1).sum(0))),
        "landed": float(throws.success.reshape(2, -1).all(0).mean()),
    }


def cells(row: dict[str, Any]) -> tuple[str, ...]:
    """A row of the table."""
    figures = [f"{row[name]:.3f}" for name in ("error_mean", "error_p95", "duration_mean")]
    return (row["way"], str(row["throws"]), *figures, f"{100.0 * row['landed']:.1f} %")


if __name__ == "__main__":
    raise SystemExit(main())
