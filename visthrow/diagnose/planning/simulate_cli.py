"""``visthrow diagnose simulate``: fly manoeuvres in the simulator, and record them like motion
capture.
"""

import argparse
from pathlib import Path

from visthrow.common.arguments import declare
from visthrow.common.errors import DiagnoseError

NOISE = {"pos_w": 5e-4, "quat_wb": 3.5e-3, "payload_pos_w": 8e-4}
"""Standard deviations of the recorded poses [m], [rad], [m], typical of motion capture in a
hall.
"""

add_arguments = declare(__file__)


def run(args: argparse.Namespace) -> int:
    """Fly each manoeuvre once, and write a log of each, or no log if one manoeuvre is refused.

    Raises DiagnoseError: a manoeuvre does not exist, or this vehicle cannot fly it."""
    from visthrow.common.compute_device import resolve_for_warp
    from visthrow.common.storage import writable
    from visthrow.diagnose.planning import manoeuvres
    from visthrow.diagnose.planning.fly_manoeuvres import fly
    from visthrow.task import load_experiment, plant_of

    chosen = manoeuvres.select_manoeuvres(dict.fromkeys(args.manoeuvres))
    plant = plant_of(load_experiment(args.plant, args.overrides))
    folder = Path(args.out)
    writable(folder)
    flights = fly(plant, chosen, args.seed, resolve_for_warp(args.device))
    for flight in flights:
        if flight.used >= 1.0:
            raise DiagnoseError(
                f"manoeuvre '{flight.manoeuvre.name}': this vehicle leaves its path, or the payload"
                " swings towards the rotors; expected a slower manoeuvre, or another --plant"
            )
    for flight in flights:
        manoeuvre = flight.manoeuvre
        path = folder / f"{Path(manoeuvre.file).stem}-{args.seed}.npz"
        flight.log(NOISE).save(path)
        print(f"{path}  {manoeuvre.name}, {manoeuvre.seconds:.1f} s")
    return 0
