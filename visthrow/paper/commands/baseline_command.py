"""``visthrow baseline``: plan throws with splines and track them with MPC; compare by target, and
with learnt policies on the Pareto front.
"""

import argparse
from collections.abc import Iterator
from pathlib import Path
from typing import Any

from visthrow.common.arguments import declare
from visthrow.common.workers import status

POLICY_THROWS = 100  # throws of each learnt policy for its point on the front

TITLE = "Trajectory optimisation and MPC: {throws} throws a row, bounds on {bounds}"
NOTE = (
    "All our figures are simulated; the plant stands in each row. The paper's TO+MPC figures come"
    " from its own pendulum model, its policies' from a real vehicle. Own-model throws vary in"
    " start only (position, velocity, attitude, cable; configs/start/hover.toml); on the plants"
    " noise, latency and extras vary too."
)


add_arguments = declare(__file__)


def run(args: argparse.Namespace) -> int:
    """Plan and throw, print the tables and write the page."""
    from visthrow.cli import compare
    from visthrow.common.storage import writable
    from visthrow.paper import results
    from visthrow.paper.baseline import thrower
    from visthrow.paper.report import result_set, trade
    from visthrow.paper.report.result_set import SHORT
    from visthrow.throws.plants import check_plant
    from visthrow.view import page
    from visthrow.view.parts import Section

    compare.check(args.targets)
    for plant in args.plants:
        check_plant(plant)
    out = Path(args.out)
    bounds = thrower.BOUNDS[args.payload_bounds]
    writable(out)
    if args.quick:
        args.throws = min(args.throws, 2)
        args.plants = []
    by_target = list(_list_units(args, bounds))
    swept = [] if args.no_sweep else list(_list_sweep_units(args, bounds))
    flights = thrower.fly_units(by_target + swept, out / "throws", status)
    rows = flights[: len(by_target)]
    front = flights[len(by_target) :]
    document = [Section("baseline", "By target", (trade.target_table(rows),))]
    if swept:
        policies = [_throw(name, args) for name in args.policies]
        kinds = [(thrower.IDEAL, "none"), *((plant, "both") for plant in args.plants)]
        panels = [
            {
                "heading": SHORT[plant],
                "plant": plant,
                "kinds": [(compensation, bounds)],
                "policies_on": "hybrid",
            }
            for plant, compensation in kinds
        ]
        names = [result.unit["policy"] for result in policies]
        document.append(
            trade.front_section(result_set.ResultSet((*front, *policies)), panels, names)
        )
        flights += policies
    status("")
    title = TITLE.format(throws=args.throws, bounds=bounds)
    print(page.markdown_of(title, NOTE, document))
    for path in page.write(out, title, NOTE, document):
        print(path)
    if args.json:
        results.pack(flights, args.json)
    return 0


def _describe(args: argparse.Namespace, bounds: str) -> dict[str, Any]:
    return {
        "bounds": bounds,
        "config_name": args.config,
        "overrides": args.overrides,
        "seed": args.seed,
    }


def _list_units(args: argparse.Namespace, bounds: str) -> Iterator[list[dict[str, Any]]]:
    """Yield the units of each row: the MPC's model first, then each plant with each
    compensation.
    """
    from visthrow.paper.baseline import thrower

    releases = _releases(args)
    for target in args.targets:
        height, speed = releases.get(target, (None, None))
        for row in thrower.rows(args.plants):
            yield thrower.units(
                *row, target, args.throws, height=height, speed=speed, **_describe(args, bounds)
            )


def _list_sweep_units(args: argparse.Namespace, bounds: str) -> Iterator[list[dict[str, Any]]]:
    """Yield the units of each setting of the sweep: in the MPC's model, and on the plants with all
    delays compensated.
    """
    from visthrow.paper.baseline import front, thrower

    speeds, weights = ((2.2,), front.WEIGHTS[2::2]) if args.quick else (front.SPEEDS, front.WEIGHTS)
    for speed in speeds:
        for w_t, rho in weights:
            for plant, compensation in [
                (thrower.IDEAL, "none"),
                *((plant, "both") for plant in args.plants),
            ]:
                how = {"speed": speed, "w_t": w_t, "rho": rho, **_describe(args, bounds)}
                yield thrower.units(plant, compensation, front.FRONT_TARGET, args.throws, **how)


def _releases(args: argparse.Namespace) -> dict[float, tuple[float, float]]:
    if not args.release_from:
        return {}
    from visthrow.paper.baseline.throw_plan import measure
    from visthrow.throws.loading import load_policy

    loaded = load_policy(args.release_from)
    status(f"measuring the releases of {loaded.name}")
    return {target: measure(loaded, target, seed=args.seed) for target in args.targets}


def _throw(name: str, args: argparse.Namespace) -> Any:
    """Throw with a learnt policy in the training simulator, as ``visthrow compare`` does."""
    from visthrow.cli.compare import throw_hybrid
    from visthrow.paper import results
    from visthrow.paper.baseline.front import FRONT_TARGET
    from visthrow.throws.loading import load_policy

    loaded = load_policy(name)
    count = 10 if args.quick else POLICY_THROWS
    ((flown,),) = throw_hybrid([loaded], [FRONT_TARGET], count, "cpu", args.seed)
    layout = loaded.policy.contract["observation"]["layout"]
    unit = results.policy_unit(loaded.name, "", layout, "hybrid", FRONT_TARGET, count, args.seed)
    return results.Result(unit, results.columns_of(flown))
