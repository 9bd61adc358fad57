"""``visthrow baseline``: plan with splines, track with MPC, throw; tables, sweep and picture of the front."""

import argparse
from pathlib import Path

from visthrow.common.arguments import add_common
from visthrow.common.errors import ConfigError
from visthrow.common.workers import status

TARGETS = (1.5, 2.0, 2.5)
POLICY_THROWS = 100
"""Of each learnt policy for its point on the front."""


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Add the arguments of the command."""
    parser.epilog = (
        "examples:\n"
        "  visthrow baseline                              tables at three targets and the sweep at 2.0 m (minutes)\n"
        "  visthrow baseline --quick                      two throws, a small sweep, own model alone\n"
        "  visthrow baseline --plants hybrid reference-realistic --no-sweep\n"
        "\nThe baseline plans the payload's path to a release state by projectile motion, with height and speed of a\n"
        "learnt policy's release, and tracks it with a nonlinear MPC. It is flown in the MPC's own pendulum model, an\n"
        "idealised upper bound, and on the plants, with and without making up for delays and the release's lag.\n"
    )
    parser.add_argument("--targets", type=float, nargs="+", default=list(TARGETS), metavar="M", help="along x [m]")
    parser.add_argument("--throws", type=int, default=10, metavar="N", help="a row (default: 10, as in the paper)")
    parser.add_argument(
        "--plants", nargs="*", default=["hybrid"], metavar="NAME",
        help="beside the own model: hybrid, reference, reference-realistic (default: hybrid)",
    )  # fmt: skip
    parser.add_argument(
        "--release-from",
        metavar="POLICY",
        help="measure release height and speed on its throws (default: as measured on the shipped state policy)",
    )
    parser.add_argument(
        "--policies", nargs="*", default=["state", "vision"], metavar="POLICY", help="points on the front"
    )
    parser.add_argument(
        "--payload-bounds",
        action="store_true",
        help="bound the payload's path alone, as the paper does, not the vehicle's thrust: plans that tracking may fail on",
    )
    parser.add_argument("--no-sweep", action="store_true", help="tables by target only")
    parser.add_argument("--quick", action="store_true", help="two throws, one speed and two weights, own model alone")
    parser.add_argument("--seed", type=int, default=0, help="of starts and noise (default: 0)")
    parser.add_argument(
        "--config", default="state", metavar="NAME", help="train config whose plant is flown (default: state)"
    )
    parser.add_argument("--out", default="out/baseline", metavar="FOLDER", help="for tables, CSV and picture")
    add_common(parser, device=False)


def run(args: argparse.Namespace) -> int:
    """Plan, throw, print, write."""
    from visthrow import config
    from visthrow.baseline import front
    from visthrow.baseline.spline import PlanParams, payload_bounds_only
    from visthrow.common.errors import suggest
    from visthrow.task import Experiment
    from visthrow.throws import compare
    from visthrow.throws.plants import PLANTS

    compare.check(args.targets, args.throws)
    for plant in args.plants:
        if plant not in PLANTS:
            raise ConfigError(f"no plant '{plant}'; {suggest(plant, PLANTS)}")
    compare.writable(Path(args.out))
    experiment = config.load(Experiment, config.find("train", args.config), args.overrides)
    plants = [] if args.quick else args.plants
    params = payload_bounds_only(PlanParams()) if args.payload_bounds else PlanParams()
    study = front.Study(experiment, min(args.throws, 2) if args.quick else args.throws, args.seed, params)
    targets = front.by_target(study, args.targets, plants, front.COMPENSATIONS, status, _releases(args))
    swept, policies = [], []
    if not args.no_sweep:
        speeds, weights = ((2.2,), front.WEIGHTS[2::2]) if args.quick else (front.SPEEDS, front.WEIGHTS)
        swept = front.sweep(study, 2.0, speeds, weights, plants, status)
        policies = _policies(args.policies, args.seed, 10 if args.quick else POLICY_THROWS)
    status("")
    return _write(args, study.throws, targets, swept, policies)


def _releases(args: argparse.Namespace) -> dict[float, tuple[float, float]]:
    if not args.release_from:
        return {}
    from visthrow.baseline.release import measure
    from visthrow.throws.loading import load_policy

    loaded = load_policy(args.release_from)
    status(f"measuring the releases of {loaded.name}")
    return {target: measure(loaded, target, seed=args.seed) for target in args.targets}


def _policies(names: list[str], seed: int, throws: int) -> list[dict]:
    """Learnt policies at 2.0 m in the training simulator, as ``visthrow compare`` throws them."""
    from visthrow.throws.loading import load_policy
    from visthrow.training.protocol import throw

    rows = []
    for name in names:
        loaded = load_policy(name)
        status(f"throwing with {loaded.name}")
        result = throw(loaded.experiment, loaded.policy.actor(throws), 2.0, throws, "cpu", seed).summary()
        if result["success"]:
            rows.append({"policy": loaded.name, "plant": "hybrid", **result})
    return rows


def _write(args: argparse.Namespace, throws: int, targets: list[dict], swept: list[dict], policies: list[dict]) -> int:
    from visthrow.baseline import front, report
    from visthrow.common import provenance
    from visthrow.common.storage import atomic_write, write_json

    sums = front.summary(swept, policies) if swept else {}
    bounds = "payload" if args.payload_bounds else "payload and thrust"
    text, folder = report.markdown(targets, swept, policies, sums, throws, bounds), Path(args.out)
    print(text)
    value = {
        "targets": targets, "sweep": swept, "policies": policies, "front": sums, "throws": throws, "seed": args.seed,
        "bounds": bounds,
        "paper": {"table": {str(k): v for k, v in front.PAPER_TABLE.items()}, "front": front.PAPER_FRONT},
        "provenance": provenance.collect(),
    }  # fmt: skip
    atomic_write(folder / "baseline.md", text)
    atomic_write(folder / "baseline.csv", report.csv_text([*targets, *swept]))
    write_json(folder / "baseline.json", value)
    written = ["baseline.md", "baseline.csv", "baseline.json"]
    if swept:
        report.draw(folder / "baseline.png", swept, policies, throws, bounds)
        written.append("baseline.png")
    for name in written:
        print(folder / name)
    if args.json:
        write_json(args.json, value)
    return 0
