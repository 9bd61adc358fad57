"""Landings of policies on each solver, from the same starts and with the same noise."""

import json
from argparse import Namespace
from collections.abc import Sequence
from pathlib import Path

import numpy as np

from bench import start
from bench.engine import overrides
from bench.report import Report, Table, device_name, finish
from visthrow.throws.loading import load_policy
from visthrow.training.protocol import throw

MOVED = (
    "Moved: distance of each landing from that on the first solver in the same throw, median and"
    " largest. A release one control step later moves a landing by some 25 mm."
)


def throw_on_solver(
    policy: str, solver: str | None, target: float, args: Namespace
) -> tuple[dict, list]:
    """Throw a policy on one solver, by default its training's; returns the record, and landings
    [m].
    """
    changes = overrides(solver, args.substep) if solver else []
    item = load_policy(policy, args.config, [*changes, *args.overrides], args.allow)
    actor = item.policy.to(args.device).actor(args.throws)
    outcome = throw(item.experiment, actor, target, args.throws, args.device, args.seed)
    name = Path(policy).stem if Path(policy).stem != "policy" else Path(policy).parent.name
    row = {"policy": name, "solver": solver or "its own", "substep": item.experiment.sim.substep}
    return {**row, **outcome.summary()}, np.nan_to_num(outcome.landing_w).round(5).tolist()


def run(args: Namespace) -> int:
    rows = []
    landings = []
    firsts = {}
    cells = []
    for policy in args.policies:
        for solver in args.solvers or [None]:
            for target in args.targets:
                row, landing_w = throw_on_solver(policy, solver, target, args)
                first = np.array(firsts.setdefault((policy, target), landing_w))
                off = np.linalg.norm(np.array(landing_w) - first, axis=1)
                row |= {"moved_median": float(np.median(off)), "moved_most": float(off.max())}
                print(json.dumps(row), flush=True)
                rows.append(row)
                landings.append(landing_w)
                landed = f"{row['success'] * args.throws:.0f} of {args.throws}"
                error = f"{row.get('error_mean', np.nan):.4f}"
                moved = f"{1e3 * row['moved_median']:.2f} / {1e3 * row['moved_most']:.1f}"
                on = f"{row['solver']}, {1e3 * row['substep']:g} ms"
                cells.append((row["policy"], f"{target:g} m", on, landed, error, moved))
    header = ("policy", "target", "solver", "landed", "mean error [m]", "moved [mm]")
    title = f"Landings by solver, {device_name(args.device)}"
    figures = {"rows": rows} | ({"landing_w": landings} if args.landings else {})
    table = Table(title, header, tuple(cells))
    return finish(Report("engine", title, (table,), (MOVED,), figures), args)


def main(argv: Sequence[str] | None = None) -> int:
    """Run the command."""
    parser = start.parser_of(__doc__)
    parser.add_argument("policies", nargs="+")
    parser.add_argument("--solvers", nargs="+", default=[])
    parser.add_argument("--substep", type=float, help="of all solvers [s]")
    parser.add_argument("--targets", type=float, nargs="+", default=[2.0])
    parser.add_argument("--throws", type=int, default=200)
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--config", help="fly in this train config")
    parser.add_argument("--allow", action="append", default=[])
    parser.add_argument("--set", dest="overrides", action="append", default=[])
    parser.add_argument("--device", default="cpu")
    parser.add_argument("--landings", action="store_true", help="keep each landing point")
    return start.main(parser, run, argv)


if __name__ == "__main__":
    raise SystemExit(main())
