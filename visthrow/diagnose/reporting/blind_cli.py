"""``visthrow diagnose blind``: detection limits of all effects in the given flights."""

import argparse
from pathlib import Path

from visthrow.common.arguments import declare
from visthrow.common.errors import DiagnoseError
from visthrow.diagnose.inputs import model_arguments as opening

add_arguments = declare(opening.__file__, __file__)


def run(args: argparse.Namespace) -> int:
    """Diagnose the flights, compute the detection limits, print and write them."""
    import dataclasses

    from visthrow.common.storage import atomic_write, check_place, write_json
    from visthrow.diagnose.reporting import blind, pictures

    check_place(Path(args.out) / "blind.json")
    opened = opening.Opened(args)
    diagnosis = opened.diagnose(laws=False)
    if diagnosis.work is None:
        raise DiagnoseError(f"{diagnosis.overall}: {'; '.join(diagnosis.reasons)}")
    hidden = blind.hide(diagnosis, seed=args.seed)
    print(f"smallest size found in 90 % of worlds; noise: {hidden.noise}")
    for curve in hidden.curves:
        print(f"  {curve.name:24} {curve.limit:10.3g} {curve.unit}")
    print(f"false alarms: {100 * hidden.false_alarms:.2f} % of {hidden.worlds} worlds")
    value = dataclasses.asdict(hidden)
    folder = Path(args.out)
    floors = [e.floor for e in opened.model.effects]
    atomic_write(folder / "completeness.png", pictures.completeness(hidden, floors))
    write_json(folder / "blind.json", value)
    if args.json:
        write_json(args.json, value)
    return 0
