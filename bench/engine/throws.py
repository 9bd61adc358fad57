"""Landings of policies on each solver, from the same starts and with the same noise."""

import json
from collections.abc import Sequence
from pathlib import Path

import numpy as np

from bench import start
from bench.engine import overrides
from bench.report import Report, Table, device_name, finish
from visthrow.throws.loading import load_policy
from visthrow.training.protocol import throw


def thrown(policy: str, solver: str | None, args) -> list[dict]:
    """Throws of one policy on one solver, a row a target; without a solver on the policy's own."""
    changes = overrides(solver, args.substep) if solver else []
    item = load_policy(policy, args.config, [*changes, *args.overrides], args.allow)
    flown, rows = item.policy.to(args.device), []
    for target in args.targets:
        actor = flown.actor(args.throws)  # with a memory of its own
        found = throw(item.experiment, actor, target, args.throws, args.device, args.seed)
        row = {
            "policy": Path(policy).stem,
            "solver": solver,
            "substep": item.experiment.sim.substep,
        }
        landed = np.where(np.isfinite(found.landing_w), found.landing_w, 0.0).round(5)
        rows.append({**row, **found.summary(), "landing_w": landed.tolist()})
    return rows


def moved(rows: list[dict], first: dict) -> tuple[float, float]:
    """Median and largest distance of landings from those of the first solver [m]."""
    other = next(
        row
        for row in rows
        if all(row[k] == first[k] for k in ("policy", "target")) and row["landing_w"]
    )
    off = np.linalg.norm(np.array(first["landing_w"]) - np.array(other["landing_w"]), axis=1)
    return float(np.median(off)), float(off.max())


def run(args) -> int:
    rows: list[dict] = []
    for policy in args.policies:
        for solver in args.solvers or [None]:
            rows += thrown(policy, solver, args)
            for row in rows[-len(args.targets) :]:
                told = {k: v for k, v in row.items() if k != "landing_w"}
                print(json.dumps(told), flush=True)
    if args.raw:
        Path(args.raw).write_text(json.dumps(rows))
    cells = []
    for row in rows:
        middle, most = moved(rows, row)
        error = f"{row['error_mean']:.4f}" if row["success"] > 0 else "-"
        landed = f"{row['success'] * row['throws']:.0f} of {row['throws']}"
        name = f"{row['solver'] or 'its own'}, {1e3 * row['substep']:g} ms"
        off = f"{1e3 * middle:.2f} / {1e3 * most:.1f}"
        row["moved_median"], row["moved_most"] = middle, most
        cells.append((row["policy"], f"{row['target']:g} m", name, landed, error, off))
    header = ("policy", "target", "solver", "landed", "mean error [m]", "moved [mm]")
    title = f"Landings by solver, {device_name(args.device)}"
    notes = (
        (
            "Moved: distance of each landing from that on the first solver in the same throw,"
            " median and largest. A release one control step later moves a landing by some 25 mm."
        ),
    )
    kept = [{k: v for k, v in row.items() if k != "landing_w"} for row in rows]
    report = Report("engine", title, (Table(title, header, tuple(cells)),), notes, {"rows": kept})
    return finish(report, args)


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
    parser.add_argument("--raw", metavar="FILE", help="rows as JSON")
    return start.main(parser, run, argv)


if __name__ == "__main__":
    raise SystemExit(main())
