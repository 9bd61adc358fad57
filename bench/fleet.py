"""A policy for many vehicles, thrown on vehicles outside its training, and compared with policies
trained for single vehicles.

Errors are in units of the rope: metres scaled to a rope of ``fleet.rope_length``.

    python -m bench.fleet any any_vision --device cuda
    python -m bench.fleet any --rivals 20 --minutes 10 --device cuda  # resumes
"""

import argparse
import math
import sys
import time
from collections.abc import Sequence
from dataclasses import asdict, dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np

from bench import start
from bench.common_options import add_common
from bench.report import Report, Table, finish
from visthrow.common.arguments import add_option
from visthrow.common.storage import atomic_write
from visthrow.common.workers import status
from visthrow.paper.measurements import body

TARGETS = (1.5, 2.0, 2.5)
NAMED = ("paper", "crazyflie_brushless", "five_inch", "x500")
RIVAL = "state_fast"
DRAWN = "drawn"
SPECIALIST = "its own"
"""Labels in tables for all drawn vehicles, and for a policy that was trained for one vehicle."""
THROWS = 1200
"""Throws at each target on one vehicle."""
QUANTILES = (0.0, 0.05, 0.25, 0.5, 0.75, 0.95, 1.0)
"""Quantiles over a group's vehicles that are recorded."""


@dataclass(frozen=True)
class Row:
    """Throws at one target on one vehicle with one policy; errors in units of the rope."""

    policy: str
    vehicle: str
    target: float
    throws: int
    landed: int
    error: float  # mean of those that landed [m at a rope of fleet.rope_length]
    duration: float  # mean [s in units of the vehicle]


def run(args: argparse.Namespace) -> int:
    """Train, throw, print, write."""
    from visthrow.common.compute_device import resolve
    from visthrow.onboard.policy import Policy, find_policy
    from visthrow.throws.loading import training_experiment

    device = resolve(args.device)
    folder = Path(args.out)
    rows = []
    paths = {
        (path.stem if path.stem != "policy" else path.resolve().parent.name): path
        for path in map(find_policy, args.policies)
    }
    policies = {name: Policy.load(path) for name, path in paths.items()}
    experiments = {
        name: training_experiment(policies[name], path, args.overrides)
        for name, path in paths.items()
    }
    rivals = _rivals(next(iter(experiments.values())), args, folder / "rivals", device)
    for name, policy in policies.items():
        groups = _groups(experiments[name], args) | {
            _label(k): _one(experiments[name], k) for k in rivals
        }
        for label, group in groups.items():
            status(f"{name} on {label}")
            vehicles = [str(k) for k in range(args.vehicles)] if label == DRAWN else [label]
            rows += _throw_fleet(
                name,
                policy,
                group,
                vehicles,
                args.throws if label == DRAWN else THROWS,
                device,
                args.seed,
            )
        _write(folder, rows, {})
    for k, (rival, experiment) in rivals.items():
        status(f"specialised policy on {_label(k)}")
        rows += _throw_fleet(SPECIALIST, rival, experiment, [_label(k)], THROWS, device, args.seed)
    status("")
    seconds = {k: rival.made_by["seconds"] for k, (rival, _) in rivals.items()}
    return finish(_write(folder, rows, seconds), args)


def _groups(experiment: Any, args: argparse.Namespace) -> dict[str, Any]:
    """Batches of vehicles: those drawn, then each of the named."""
    drawn = replace(experiment, fleet=replace(experiment.fleet, count=args.vehicles, first=0))
    return ({DRAWN: drawn} if args.vehicles else {}) | {
        name: _one(experiment, name) for name in args.named
    }


def _label(vehicle: str) -> str:
    """What a table calls a vehicle by its name or number."""
    return f"vehicle {vehicle}" if vehicle.isdigit() else vehicle


def _one(experiment: Any, vehicle: str) -> Any:
    """Experiment of one vehicle, by its name or the number of its draw."""
    if vehicle.isdigit():
        return replace(experiment, fleet=replace(experiment.fleet, count=1, first=int(vehicle)))
    return _load_vehicle(experiment, vehicle)


def _load_vehicle(experiment: Any, name: str) -> Any:
    """Experiment of one named vehicle and its rope, which are in SI units."""
    from sim.params import RopeParams, VehicleParams
    from visthrow import config

    vehicle = config.load(VehicleParams, config.find("vehicle", name))
    rope = config.load(RopeParams, config.find("rope", name))
    fleet = replace(experiment.fleet, count=0)
    return replace(experiment, vehicle=vehicle, rope=rope, fleet=fleet)


def _throw_fleet(
    name: str,
    policy: Any,
    experiment: Any,
    vehicles: Sequence[str],
    each: int,
    device: str,
    seed: int,
) -> list[Row]:
    """Throw on all vehicles of an experiment's fleet; each has a share of the ropes."""
    from visthrow.training.protocol import throw

    ropes = experiment.task.start.tether_variants
    count = len(vehicles) * ropes * max(round(each / ropes), 1)
    on = policy.to(device)
    rows = []
    number = np.arange(count) % (len(vehicles) * ropes) // ropes
    for target in TARGETS:
        thrown = throw(experiment, on.actor(count), target, count, device, seed)
        for k, vehicle in enumerate(vehicles):
            mask = number == k
            good = mask & thrown.success
            error, duration = (
                float(x[good].mean()) if good.any() else math.nan
                for x in (thrown.error, thrown.duration)
            )
            rows.append(
                Row(name, vehicle, target, int(mask.sum()), int(good.sum()), error, duration)
            )
    return rows


def _rivals(
    experiment: Any, args: argparse.Namespace, folder: Path, device: str
) -> dict[str, tuple[Any, Any]]:
    """Train a policy for each of some vehicles until the time is over: vehicle -> policy and
    experiment.
    """
    from visthrow.onboard.policy import Policy
    from visthrow.task import load_experiment

    recipe = load_experiment(RIVAL)
    ppo = replace(recipe.ppo, iterations=args.rival_iterations or recipe.ppo.iterations)
    task = replace(
        experiment.task, observation=replace(experiment.task.observation, setup="none", response=0)
    )
    base = replace(experiment, ppo=ppo, task=task)
    begin = time.monotonic()
    vehicles = [
        *map(str, range(args.rivals)),
        *(args.named if args.named_rivals else ()),
    ]
    longest = 0.0
    for vehicle in vehicles:
        path = folder / f"{vehicle}.npz"
        start = time.monotonic()
        if path.exists() or start - begin + longest > 60.0 * args.minutes:
            continue
        status(f"training for {_label(vehicle)}, of {len(vehicles)}")
        _train(_one(base, vehicle), device).save(path)
        longest = max(longest, time.monotonic() - start)
    paths = {vehicle: folder / f"{vehicle}.npz" for vehicle in vehicles}
    return {
        vehicle: (Policy.load(path), _one(base, vehicle))
        for vehicle, path in paths.items()
        if path.exists()
    }


def _train(experiment: Any, device: str) -> Any:
    """Policy trained for an experiment, with its seconds in the provenance."""
    from visthrow.common import provenance
    from visthrow.task import contract_of
    from visthrow.training.trainer import Trainer

    start = time.monotonic()
    trainer = Trainer(experiment, device, 1)
    while trainer.iteration < trainer.algorithm.iterations:
        trainer.step()
    made_by = {**provenance.collect(), "seconds": time.monotonic() - start}
    return trainer.algorithm.export(contract_of(experiment), made_by)


def _write(folder: Path, rows: Sequence[Row], seconds: dict[str, float]) -> Report:
    """Rows as CSV; the table."""
    report = _report(rows, seconds)
    lines = [
        ",".join(Row.__dataclass_fields__),
        *(",".join(str(x) for x in vars(row).values()) for row in rows),
    ]
    atomic_write(folder / "fleet.csv", "\n".join(lines) + "\n")
    atomic_write(folder / "fleet.md", body(asdict(report)) + "\n")
    return report


def _report(rows: Sequence[Row], seconds: dict[str, float]) -> Report:
    """Report the drawn vehicles, the named, and those with a specialised policy one by one and in
    the mean.
    """

    def cells(label: str, policy: str, vehicles: Sequence[str]) -> tuple[str, ...]:
        of = [
            [r for r in rows if r.policy == policy and r.vehicle in vehicles and r.target == target]
            for target in TARGETS
        ]
        errors = [f"{np.nanmean([r.error for r in row]):.3f}" for row in of]
        landed = min(sum(r.landed for r in row) / sum(r.throws for r in row) for row in of)
        return label, policy, str(len(of[0])), *errors, f"{100 * landed:.1f}"

    names = list(dict.fromkeys(row.vehicle for row in rows))
    rivals = [_label(k) for k in seconds]
    groups = {DRAWN: [v for v in names if v.isdigit()]} | {v: [v] for v in names if not v.isdigit()}
    groups |= {"those with a specialised policy": rivals} if len(rivals) > 1 else {}
    thrown = {(row.policy, row.vehicle) for row in rows}
    policies = list(dict.fromkeys(row.policy for row in rows))
    shown = [
        (label, policy, vehicles)
        for label, vehicles in groups.items()
        for policy in policies
        if vehicles and all((policy, vehicle) in thrown for vehicle in vehicles)
    ]
    header = (
        "vehicles",
        "policy",
        "n",
        *(f"{target:g} m" for target in TARGETS),
        "landed, least [%]",
    )
    spent = (
        (f"Training one policy: {np.mean(list(seconds.values())):.0f} s, mean of {len(seconds)}.",)
        if seconds
        else ()
    )
    tables = (
        Table(
            "Mean landing error [m at a rope of 0.33 m]",
            header,
            tuple(cells(*group) for group in shown),
        ),
    )
    spread = [_spread(*group, rows) for group in shown if len(group[2]) > 1]
    return Report(
        "fleet",
        "One policy for many vehicles",
        tables,
        spent,
        {"spread": spread, "seconds": seconds},
    )


def _spread(
    label: str, policy: str, vehicles: Sequence[str], rows: Sequence[Row]
) -> dict[str, Any]:
    """Quantiles of the vehicles' mean errors, at each target and over all of them; the rows are in
    ``fleet.csv``.
    """
    of = np.array(
        [
            [
                r.error
                for r in rows
                if r.policy == policy and r.vehicle in vehicles and r.target == t
            ]
            for t in TARGETS
        ]
    )
    named = zip((*(f"{t:g}" for t in TARGETS), "all"), (*of, of.mean(0)))
    errors = {name: np.nanquantile(values, QUANTILES).round(4).tolist() for name, values in named}
    return {
        "vehicles": label,
        "policy": policy,
        "n": len(vehicles),
        "quantiles": QUANTILES,
        "error": errors,
    }


def main(argv: Sequence[str] | None = None) -> int:
    """Run the command."""
    parser = start.parser_of(__doc__)
    parser.add_argument(
        "policies", metavar="POLICY", nargs="+", help="trained for a fleet: shipped names or files"
    )
    parser.add_argument(
        "--vehicles",
        type=int,
        default=500,
        metavar="N",
        help="drawn, numbers 0 to N - 1 (default: 500)",
    )
    parser.add_argument(
        "--throws",
        type=int,
        default=6,
        metavar="N",
        help="on each of them and target, one a rope's length (default: 6)",
    )
    parser.add_argument(
        "--named",
        nargs="*",
        default=list(NAMED),
        metavar="NAME",
        help=f"of configs/vehicle (default: {' '.join(NAMED)})",
    )
    rivals = (
        "train a policy for each of the first N as well, as configs/train/state_fast.toml does;"
        " those in the folder are kept"
    )
    parser.add_argument("--rivals", type=int, default=0, metavar="N", help=rivals)
    parser.add_argument(
        "--rival-iterations",
        type=int,
        metavar="N",
        help="of such a training (default: the configuration's)",
    )
    parser.add_argument(
        "--named-rivals", action="store_true", help="train one for each named vehicle too"
    )
    parser.add_argument(
        "--minutes",
        type=float,
        default=math.inf,
        metavar="T",
        help="begin no training that would end later",
    )
    parser.add_argument("--seed", type=int, default=0, help="of starts and noise (default: 0)")
    text = "for tables and the rivals' policies (default: %(default)s)"
    add_option(parser, "--out", shared=True, default="out/fleet", help=text)
    add_common(parser, json=False)
    return start.main(parser, run, argv)


if __name__ == "__main__":
    sys.exit(main())
