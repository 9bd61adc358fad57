"""``visthrow bench fleet``: a policy for many vehicles, thrown on vehicles it never saw, and beside policies trained for each of some.

Errors are in units of the rope: metres at a rope of ``fleet.rope_length``, whatever a vehicle's own is.
"""

import argparse
import math
import time
from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np

from visthrow.common.arguments import add_common, add_out
from visthrow.common.storage import atomic_write, write_json
from visthrow.common.workers import status

TARGETS = (1.5, 2.0, 2.5)
NAMED = ("paper", "crazyflie_brushless", "five_inch", "x500")
RIVAL = "state_fast"
THROWS = 1200
"""Throws at each target on one vehicle."""


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Add the arguments of the action."""
    parser.add_argument("policies", metavar="POLICY", nargs="+", help="trained for a fleet: shipped names or files")
    parser.add_argument("--vehicles", type=int, default=500, metavar="N", help="drawn, numbers 0 to N - 1 (default: 500)")
    parser.add_argument("--throws", type=int, default=6, metavar="N", help="on each of them and target, one a rope's length (default: 6)")
    parser.add_argument("--named", nargs="*", default=list(NAMED), metavar="NAME", help=f"of configs/vehicle (default: {' '.join(NAMED)})")
    rivals = "train a policy for each of the first N as well, as configs/train/state_fast.toml does; those in the folder are kept"
    parser.add_argument("--rivals", type=int, default=0, metavar="N", help=rivals)
    parser.add_argument("--rival-iterations", type=int, metavar="N", help="of such a training (default: the configuration's)")
    parser.add_argument("--named-rivals", action="store_true", help="train one for each named vehicle too")
    parser.add_argument("--minutes", type=float, default=math.inf, metavar="T", help="begin no training that would end later")
    parser.add_argument("--seed", type=int, default=0, help="of starts and noise (default: 0)")
    add_out(parser, "out/fleet", "for tables and the rivals' policies")
    add_common(parser)


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
    """Throw, train, throw, print, write."""
    from visthrow.onboard.policy import Policy, find_policy
    from visthrow.throws.loading import trained_in
    from visthrow.training.device import resolve

    begin, device, folder = time.monotonic(), resolve(args.device), Path(args.out)
    rows: list[Row] = []
    paths = [find_policy(name) for name in args.policies]
    for path in paths:
        name = path.stem if path.stem != "policy" else path.resolve().parent.name
        policy = Policy.load(path)
        experiment = trained_in(policy, path, args.overrides)
        for names, group in _groups(experiment, args):
            status(f"{name} on {len(names)} vehicles")
            rows += _thrown(name, policy, group, names, args.throws if len(names) > 1 else THROWS, device, args.seed)
        _write(folder, rows, {})
    experiment = trained_in(Policy.load(paths[0]), paths[0], args.overrides)
    seconds = _rivals(experiment, args, folder, device, rows, begin)
    status("")
    _write(folder, rows, seconds)
    print(_told(rows, seconds))
    if args.json:
        write_json(args.json, {"rows": [vars(row) for row in rows], "seconds": seconds})
    return 0


def _groups(experiment: Any, args: argparse.Namespace) -> list[tuple[list[str], Any]]:
    """Batches of vehicles: those drawn, then each of the named."""
    drawn = replace(experiment, fleet=replace(experiment.fleet, count=args.vehicles, first=0))
    groups = [([str(k) for k in range(args.vehicles)], drawn)] if args.vehicles else []
    return groups + [([name], _named(experiment, name)) for name in args.named]


def _named(experiment: Any, name: str) -> Any:
    """Experiment of one named vehicle and its rope, which are in SI units."""
    from sim.params import RopeParams, VehicleParams
    from visthrow import config

    vehicle = config.load(VehicleParams, config.find("vehicle", name))
    rope, fleet = config.load(RopeParams, config.find("rope", name)), replace(experiment.fleet, count=0)
    return replace(experiment, vehicle=vehicle, rope=rope, fleet=fleet)


def _thrown(name: str, policy: Any, experiment: Any, vehicles: Sequence[str], each: int, device: str, seed: int) -> list[Row]:
    """Throw on all vehicles of an experiment's fleet; each has a share of the ropes."""
    from visthrow.training.protocol import throw

    ropes = experiment.task.start.tether_variants
    count = len(vehicles) * ropes * max(round(each / ropes), 1)
    on, rows = policy.to(device), []
    number = np.arange(count) % (len(vehicles) * ropes) // ropes
    for target in TARGETS:
        thrown = throw(experiment, on.actor(count), target, count, device, seed)
        for k, vehicle in enumerate(vehicles):
            own = number == k
            good = own & thrown.success
            error, duration = (float(x[good].mean()) if good.any() else math.nan for x in (thrown.error, thrown.duration))
            rows.append(Row(name, vehicle, target, int(own.sum()), int(good.sum()), error, duration))
    return rows


def _rivals(
    experiment: Any, args: argparse.Namespace, folder: Path, device: str, rows: list[Row], begin: float
) -> dict[str, float]:
    """Train a policy for each of some vehicles, as far as the time goes, and throw with it; adds rows, returns seconds a training."""
    from visthrow import config
    from visthrow.onboard.policy import Policy
    from visthrow.task import Experiment

    recipe = config.load(Experiment, config.find("train", RIVAL))
    ppo = replace(recipe.ppo, iterations=args.rival_iterations or recipe.ppo.iterations)
    task = replace(experiment.task, observation=replace(experiment.task.observation, setup="none", response=0))
    base = replace(experiment, ppo=ppo, task=task)
    chosen = {str(k): replace(base, fleet=replace(base.fleet, count=1, first=k)) for k in range(args.rivals)}
    chosen |= {name: _named(base, name) for name in (args.named if args.named_rivals else ())}
    seconds: dict[str, float] = {}
    for name, own in chosen.items():
        path = folder / "rivals" / f"{name}.npz"
        longest = max(seconds.values(), default=0.0)
        if not path.exists():
            if time.monotonic() - begin + longest > 60.0 * args.minutes:
                continue
            status(f"training for vehicle {name}, {len(seconds) + 1} of {len(chosen)}")
            _trained(own, device).save(path)
        policy = Policy.load(path)
        seconds[name] = policy.made_by["seconds"]
        rows += _thrown("own", policy, own, [name], THROWS, device, args.seed)
        _write(folder, rows, seconds)
    return seconds


def _trained(experiment: Any, device: str) -> Any:
    """Policy trained for an experiment; tells the seconds that it took."""
    from visthrow.common import provenance
    from visthrow.task import contract_of
    from visthrow.training.trainer import Trainer

    start, trainer = time.monotonic(), Trainer(experiment, device, 1)
    while trainer.iteration < trainer.algorithm.iterations:
        trainer.step()
    told = {**provenance.collect(), "seconds": time.monotonic() - start}
    return trainer.algorithm.export(contract_of(experiment), told)


def _write(folder: Path, rows: Sequence[Row], seconds: dict[str, float]) -> None:
    """Rows as CSV; the table."""
    lines = [",".join(Row.__dataclass_fields__), *(",".join(str(x) for x in vars(row).values()) for row in rows)]
    atomic_write(folder / "fleet.csv", "\n".join(lines) + "\n")
    atomic_write(folder / "fleet.md", _told(rows, seconds))


def _told(rows: Sequence[Row], seconds: dict[str, float]) -> str:
    """Tables: all drawn vehicles; those with a policy of their own, and the named."""
    from visthrow.view.parts import aligned

    def mean(policy: str, target: float, wanted: Any) -> tuple[float, float, int]:
        of = [row for row in rows if row.policy == policy and row.target == target and wanted(row.vehicle)]
        landed, throws = sum(row.landed for row in of), sum(row.throws for row in of)
        errors = [row.error for row in of if row.landed]
        return float(np.mean(errors)) if errors else math.nan, landed / max(throws, 1), len(of)

    policies = list(dict.fromkeys(row.policy for row in rows))
    named = list(dict.fromkeys(row.vehicle for row in rows if not row.vehicle.isdigit()))
    groups = [("drawn", str.isdigit), ("drawn, with a policy of their own", lambda v: v.isdigit() and v in seconds)]
    groups += [(name, lambda v, name=name: v == name) for name in named]
    cells = []
    for label, wanted in groups:
        for policy in policies:
            found = [mean(policy, target, wanted) for target in TARGETS]
            if found[0][2] and not (policy == "own" and label == "drawn"):
                least = f"{100 * min(share for _, share, _ in found):.1f}"
                cells.append((label, policy, str(found[0][2]), *(f"{error:.3f}" for error, _, _ in found), least))
    header = ("vehicles", "policy", "n", *(f"{target:g} m" for target in TARGETS), "landed, least [%]")
    spent = f"\nTraining one policy: {np.mean(list(seconds.values())):.0f} s, mean of {len(seconds)}.\n" if seconds else "\n"
    return f"Mean landing error [m at a rope of 0.33 m]\n\n{aligned(header, cells)}\n{spent}"
