"""``visthrow diagnose loop``: hide an effect in the reference plant, find it in flights, train with it, fly again."""

import argparse
from pathlib import Path

DEFAULT_OUT = "runs/loop"
DEFAULT_BASE = "state"


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Add the arguments of the action."""
    parser.epilog = (
        "examples:\n"
        "  visthrow diagnose loop --hide motor_tau=0.02         a slower motor; minutes on a GPU, hours on a CPU\n"
        "  visthrow diagnose loop --base state_no_motor_lag --policy runs/state_no_motor_lag-1/policy.npz --hide motor_lag=1\n"
        "                                                       a model that lacks a block, and the policy trained in it\n"
        "  visthrow diagnose loop --ablations                   the paper's four: each model lacks a block; what is named?\n"
        "                                                       nothing is trained; minutes on two cores\n"
        "  visthrow diagnose loop --ablations no_motor_lag      one of them\n"
        "  visthrow diagnose loop --ablations --show            what they were told of last, from the committed record\n"
        "  visthrow diagnose loop --show                        the loops that are told of, from their committed records\n"
        "  visthrow diagnose loop --show runs/loop/* --picture loops.png     loops of one's own\n"
    )
    parser.add_argument("--hide", action="append", default=[], metavar="EFFECT=SIZE", help="of the catalogue; may be repeated")
    parser.add_argument("--ablations", nargs="*", metavar="NAME", help="hide blocks of the model and name them; train nothing")
    parser.add_argument("--base", default=DEFAULT_BASE, metavar="NAME", help="of configs/train: what is diagnosed (default: state)")
    parser.add_argument("--policy", default=DEFAULT_BASE, metavar="NAME", help="trained in it: shipped, or a file (default: state)")
    parser.add_argument("--show", type=Path, nargs="*", metavar="FOLDER", help="run nothing, show loops (default: those committed)")
    parser.add_argument("--picture", type=Path, metavar="FILE", help="with --show: draw them, a PNG")
    parser.add_argument("--flights", type=int, default=12, help="that are diagnosed (default: 12)")
    parser.add_argument("--held", type=int, default=3, help="with --ablations: throws held back (default: 3)")
    parser.add_argument("--throws", type=int, default=200, help="of each policy in the end (default: 200)")
    parser.add_argument("--processes", type=int, help="for flights and throws (default: one a core)")
    parser.add_argument("--device", default="auto", metavar="NAME", help="of the trainings")
    parser.add_argument("--diagnose-on", default="cpu", metavar="NAME", help="device of the diagnosis (default: cpu)")
    parser.add_argument("--set", action="append", default=[], dest="changes", metavar="KEY=VALUE", help="in the trainings")
    parser.add_argument("--out", default=DEFAULT_OUT, metavar="FOLDER", help=f"(default: {DEFAULT_OUT})")


def run(args: argparse.Namespace) -> int:
    """Go round for the effects, all hidden at once, or show what was run."""
    from visthrow.common.errors import ConfigError
    from visthrow.common.storage import atomic_write
    from visthrow.diagnose.proof import loop

    if args.ablations is not None:
        return _ablations(args)
    if args.show is not None:
        records = loop.read(args.show)
        print(loop.table(records))
        if args.picture:
            atomic_write(args.picture, loop.picture(records))
        return 0
    hidden = {}
    for item in args.hide:
        name, _, size = item.partition("=")
        try:
            hidden[name] = float(size)
        except ValueError:
            raise ConfigError(f"--hide {item}; expected EFFECT=SIZE, such as motor_tau=0.02") from None
    if not hidden:
        raise ConfigError("nothing to hide; name an effect, such as --hide motor_tau=0.02, or say --show")
    from visthrow.training.device import cores, resolve

    parts = [f"{n}_{v:g}" for n, v in hidden.items()]
    folder = Path(args.out) / "-".join(parts if args.base == DEFAULT_BASE else [args.base, *parts])
    record = loop.Loop(
        hidden, folder, args.base, args.policy, flights=args.flights, throws=args.throws, device=resolve(args.device),
        diagnose_on=resolve(args.diagnose_on),
        processes=args.processes or cores(), changes=tuple(args.changes),
    ).run(lambda line: print(f"  {line}", flush=True))  # fmt: skip
    print("\n" + loop.table([record]))
    return 0


def _ablations(args: argparse.Namespace) -> int:
    """Name the blocks that models lack, or show what was named."""
    from visthrow.diagnose.proof import ablations
    from visthrow.training.device import resolve

    if args.show is not None:
        print("\n\n".join(ablations.table(ablations.read(place)) for place in args.show or (None,)))
        return 0
    names = tuple(args.ablations) or tuple(ablations.LACKS)
    one = ablations.Ablations(
        Path(args.out) / "ablations", names, args.policy, args.flights, args.held, resolve(args.diagnose_on)
    )
    print("\n" + ablations.table(one.run(lambda line: print(f"  {line}", flush=True))))
    return 0
