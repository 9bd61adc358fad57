"""``visthrow diagnose plan``: rank the next flights by the evidence expected from them, and write
their reference trajectories.
"""

import argparse
from pathlib import Path
from typing import Any

from visthrow.common.arguments import declare
from visthrow.common.errors import DiagnoseError
from visthrow.diagnose.inputs import model_arguments as opening

add_arguments = declare(opening.__file__, __file__)


def run(args: argparse.Namespace) -> int:
    """Diagnose the flights, simulate and rank manoeuvres, optimise one, and write references."""
    import dataclasses

    from visthrow.common.storage import atomic_write, check_place
    from visthrow.diagnose.inputs import setup
    from visthrow.diagnose.planning import design, plan
    from visthrow.diagnose.planning.fly_manoeuvres import simulator_of
    from visthrow.diagnose.planning.manoeuvres import catalogue, select_manoeuvres
    from visthrow.diagnose.reporting import diagnosis_report as report
    from visthrow.diagnose.reporting import pictures

    check_place(Path(args.out) / "plan.json")
    limits = _limits(args)
    chosen = select_manoeuvres(args.manoeuvres) if args.manoeuvres else catalogue()
    opened = opening.Opened(args)
    diagnosis = opened.diagnose(laws=False)
    print(report.summary(diagnosis) + "\n")
    if diagnosis.work is None:
        raise DiagnoseError(f"{diagnosis.overall}: {'; '.join(diagnosis.reasons)}")
    aim = plan.PlanningGoal(diagnosis, args.about)
    simulate, flown = simulator_of(
        opened.model,
        diagnosis,
        lambda logs: setup.model_of(setup.load(args.config), logs),
        seed=args.seed,
    )
    manoeuvres = [m for m in map(flown, chosen) if m is not None]
    print(f"simulating {len(manoeuvres)} manoeuvres ...", flush=True)
    informed = [
        (m, aim.information(s.model))
        for m, s in zip(manoeuvres, simulate(manoeuvres))
        if s.model is not None
    ]
    designed = None
    if informed and args.steps > 0:
        base = max(informed, key=lambda candidate: aim.nats(candidate[1]) / candidate[0].seconds)[0]
        designed = design.optimise(
            aim, base, simulate, limits, seed=args.seed, steps=args.steps, progress=print
        )
    if designed:
        informed.append((designed.manoeuvre, designed.information))
        rates = {m.name: aim.nats(information) / m.seconds for m, information in informed}
        picture = pictures.draw_plan(designed.base, designed.manoeuvre, rates)
        atomic_write(Path(args.out) / "plan.png", picture)
    ranked = plan.propose(aim, informed)
    for manoeuvre, _ in informed:
        atomic_write(Path(args.out) / manoeuvre.file, manoeuvre.csv())
    _print(ranked)
    session = plan.session(ranked)
    if session:
        times = [p.name + f" x{p.repeats}" * (p.repeats > 1) for p in session]
        print(f"flights that separate most together: {', '.join(times)}")
    extra = {
        "proposals": [dataclasses.asdict(p) for p in ranked],
        "session": [p.name for p in session],
        "optimised": designed.record() if designed else None,
    }
    _write(args, report.to_json(diagnosis, extra=extra))
    return 0


def _write(args: argparse.Namespace, value: dict[str, Any]) -> None:
    """Write the plan, and the settings with which autopilots fly sweeps themselves."""
    from visthrow.common.storage import write_json
    from visthrow.diagnose.planning import manoeuvre_excitation as excitation

    write_json(Path(args.out) / "plan.json", value)
    sweeps = ", ".join(path.name for path in excitation.write(args.out))
    print(f"references as CSV: {args.out}\nsettings for sweeps flown by the autopilot: {sweeps}")
    if args.json:
        write_json(args.json, value)


def _limits(args: argparse.Namespace):
    from visthrow.diagnose.planning.design import Limits

    try:
        x, y, z = (float(part) for part in args.hall.split(","))
        return Limits(half=(0.5 * x, 0.5 * y), highest=z, speed=args.speed)
    except (ValueError, DiagnoseError) as error:
        raise DiagnoseError(
            f"--hall {args.hall}: expected three lengths in metres between commas, such as"
            f" 5,5,2.6, and a height above {Limits.lowest:g} m, the lowest that is flown"
        ) from error


def _print(ranked) -> None:
    print(
        f"{'manoeuvre or measurement':40} {'seconds':>7} {'nats':>8} {'a second':>8} {'times':>5} "
        " separates"
    )
    for p in ranked:
        separates = "; ".join(" from ".join(group) for group in p.separates) or "-"
        print(
            f"{p.name:40} {p.seconds:7.1f} {p.nats:8.2f} {p.nats / p.seconds:8.3f}"
            f" {p.repeats or '-':>5}  {separates}"
        )
