"""``visthrow cooperative``: throw one load with several vehicles."""

import argparse
from pathlib import Path
from typing import Any

from visthrow.common.arguments import declare

POLICIES = ("pair", "pair_vision")
"""Shipped policies; ``configs/cooperative`` holds a configuration with the name of each."""

SHIPPED = Path(__file__).with_name("policies")


add_arguments = declare(__file__)


def run(args: argparse.Namespace) -> int:
    """Throw once, or many times for a comparison."""
    if args.action == "compare":
        return _compare(args)
    return _fly(args)


def load(name: str, solver: str) -> tuple[Any, Any, Any]:
    """Return experiment, policy and solver of throws.

    Raises PolicyError: no such policy; MismatchError: the policy is for another team or task.
    """
    from visthrow.common.errors import PolicyError, VisthrowError, suggest
    from visthrow.common.extras import load_extra
    from visthrow.cooperative.team import TeamExperiment, team_contract
    from visthrow.onboard.policy import Policy
    from visthrow.throws.loading import training_experiment

    file = Path(name)
    if not file.is_file():
        file = SHIPPED / f"{name}.npz"
    if not file.is_file():
        raise PolicyError(
            f"no policy '{name}', neither a file nor shipped; {suggest(name, POLICIES)}"
        )
    policy = Policy.load(file)
    changes = []
    build = None
    if solver == "mujoco":
        changes = ["rope.segments=15"]
        module = "visthrow.cooperative.referee"
        build = load_extra(module, "reference", "--solver mujoco", VisthrowError).MujocoTeam
    experiment = training_experiment(policy, file, changes, TeamExperiment)
    policy.require(team_contract(experiment), allow=("team", "rope"))
    return experiment, policy, build


def _fly(args: argparse.Namespace) -> int:
    """Throw once, print the result and write the files."""
    from visthrow.common.storage import writable
    from visthrow.cooperative.throw_track import record_throw, write

    folder = Path(args.out)
    writable(folder)
    experiment, policy, build = load(args.policy, args.solver)
    options = {"fault": args.fault, "target": args.target, "seed": args.seed, "build": build}
    track = record_throw(experiment, policy.act, **options)
    if not track.released:
        print("The load was not released.")
    else:
        print(
            f"Landed {100 * track.landing_error:.1f} cm from the target,"
            f" {track.flight_time[-1]:.2f} s after the start."
        )
    for path in write(track, folder, experiment.rope.payload_radius):
        print(f"  {path}")
    return 0


def _compare(args: argparse.Namespace) -> int:
    """Throw many times and print a table."""
    from visthrow.common.storage import write_json
    from visthrow.cooperative.team import FAULTS
    from visthrow.cooperative.team_training import throw
    from visthrow.view.parts import align

    rows = []
    cells = []
    for name in args.policies:
        experiment, policy, build = load(name, args.solver)
        for fault in FAULTS:
            options = {"fault": fault, "target": args.target, "seed": args.seed, "build": build}
            row = throw(experiment, policy.act, count=args.throws, **options)
            rows.append({"policy": name, "solver": args.solver, **row})
            cells.append(_cells(rows[-1]))
    heads = "policy | fault | throws | error [m] | 95 % [m] | duration [s] | landed | contact"
    print(align(heads.split(" | "), cells, heads=2))
    if args.json:
        write_json(args.json, rows)
    return 0


def _cells(row: dict[str, Any]) -> tuple[str, ...]:
    """Return a row of the table."""
    figures = [
        f"{row[name]:.3f}" if name in row else "-"
        for name in ("error_mean", "error_p95", "duration_mean")
    ]
    shares = [f"{100 * row[name]:.1f} %" for name in ("landed", "contact")]
    return (row["policy"], row["fault"], str(row["throws"]), *figures, *shares)
