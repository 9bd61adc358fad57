"""``visthrow diagnose blind``: effects hidden in your own noise, and which sizes of them would have
been named.
"""

import argparse
from pathlib import Path

from visthrow.common.arguments import ABOVE_ZERO, WHOLE, add_out
from visthrow.common.errors import DiagnoseError


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Add the arguments of the action."""
    from visthrow.diagnose.inputs.model_arguments import add_arguments as shared

    parser.epilog = (
        "examples:\n  visthrow diagnose blind flights/*.npz                 detection limits of"
        " every effect in these flights\n  visthrow diagnose blind flights/*.npz --verify 5     "
        " and five hidden in the measurements, each searched for anew\n"
    )
    shared(parser)
    parser.add_argument(
        "--verify",
        type=WHOLE,
        default=0,
        metavar="N",
        help="also hide N effects in the measurements themselves",
    )
    parser.add_argument(
        "--floors", type=ABOVE_ZERO, default=10.0, help="size of those, in floors (default: 10)"
    )
    add_out(parser, "out/blind", "of picture and JSON")


def run(args: argparse.Namespace) -> int:
    """Search once, hide, print, write."""
    import dataclasses

    from visthrow.common.storage import atomic_write, check_place, write_json
    from visthrow.diagnose.inputs import model_arguments as opening
    from visthrow.diagnose.reporting import blind, pictures

    check_place(Path(args.out) / "blind.json")
    opened = opening.Opened(args)
    diagnosis = opened.diagnose(laws=False)
    if diagnosis.work is None:
        raise DiagnoseError(f"{diagnosis.overall}: {'; '.join(diagnosis.reasons)}")
    hidden = blind.hide(diagnosis, seed=args.seed)
    print(f"smallest size named in 90 % of worlds; noise: {hidden.noise}")
    for curve in hidden.curves:
        print(f"  {curve.name:24} {curve.limit:10.3g} {curve.unit}")
    print(f"false alarms: {100 * hidden.false_alarms:.2f} % of {hidden.worlds} worlds")
    trials = (
        blind.verify(diagnosis, args.verify, floors=args.floors, seed=args.seed)
        if args.verify
        else []
    )
    for t in trials:
        verdict = (
            f"{t.verdict}, {t.estimate:+.3g} of {t.expected:+.3g}; named"
            f" {', '.join(t.named) or 'nothing'}"
        )
        print(f"  hidden {t.name} {t.size:+.3g} {t.unit}: {verdict}")
    value = {**dataclasses.asdict(hidden), "trials": [dataclasses.asdict(t) for t in trials]}
    folder = Path(args.out)
    floors = [e.floor for e in opened.model.effects]
    atomic_write(folder / "completeness.png", pictures.completeness(hidden, floors))
    write_json(folder / "blind.json", value)
    if args.json:
        write_json(args.json, value)
    return 0
