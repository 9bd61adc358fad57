"""``visthrow diagnose plan``: which manoeuvre separates what could not be separated, with its reference to fly."""

import argparse
from pathlib import Path

from visthrow.common.arguments import add_out


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Add the arguments of the action."""
    from visthrow.diagnose.inputs.opening import add_arguments as shared

    parser.epilog = (
        "examples:\n"
        "  visthrow diagnose plan flights/*.npz                                the next flight after these\n"
        "  visthrow diagnose plan flights/*.npz --about ground_effect          what would show this effect\n"
        "  visthrow diagnose plan flights/*.npz --manoeuvres hover,circle      choose among some\n"
    )
    shared(parser)
    parser.add_argument("--manoeuvres", metavar="NAMES", help="choose among these, by commas; default all")
    parser.add_argument("--about", metavar="NAMES", default="", help="plan for these effects, by commas; default: all unclear ones")
    add_out(parser, "out/plan", "of references and JSON")


def run(args: argparse.Namespace) -> int:
    """Search, simulate the manoeuvres, rank, write."""
    import dataclasses

    from visthrow.common.errors import DiagnoseError, suggest
    from visthrow.common.storage import write_json
    from visthrow.diagnose.inputs import opening
    from visthrow.diagnose.planning import excitation, manoeuvres, plan
    from visthrow.diagnose.planning.fly_manoeuvres import simulator_of
    from visthrow.diagnose.reporting import report
    from visthrow.diagnose.select import search
    from visthrow.diagnose.throw.throw_model import ThrowModel

    model, _ = opening.open_model(args)
    if not isinstance(model, ThrowModel):
        raise DiagnoseError("manoeuvres are flown by the vehicle; a plan needs the model of the throw, not of a setup")
    known = {m.name: m for m in manoeuvres.catalogue()}
    chosen = args.manoeuvres.split(",") if args.manoeuvres else list(known)
    for name in chosen:
        if name not in known:
            raise DiagnoseError(f"no manoeuvre '{name}'; {suggest(name, known)}")
    diagnosis = search.explain(model, seed=args.seed, without=opening.numbers(args.without), laws=False)
    print(report.summary(diagnosis) + "\n")
    if diagnosis.work is None:
        raise DiagnoseError(f"{diagnosis.overall}: {'; '.join(diagnosis.reasons)}")
    flights = [known[name] for name in chosen]
    about = tuple(name for name in args.about.split(",") if name)
    ranked = plan.propose(diagnosis, flights, simulator_of(model, diagnosis, seed=args.seed), about)
    ranked = plan.write_references(args.out, flights, ranked)
    print(f"{'manoeuvre or measurement':28} {'seconds':>7} {'nats':>8} {'times':>7}  separates")
    for p in ranked:
        separates = "; ".join(" from ".join(group) for group in p.separates) or "-"
        print(f"{p.name:28} {p.seconds:7.1f} {p.nats:8.1f} {p.repeats or '-':>7}  {separates}")
    session = plan.session(ranked)
    if session:
        print(f"together they settle the most: {', '.join(p.name + f' x{p.repeats}' * (p.repeats > 1) for p in session)}")
    value = report.to_json(
        diagnosis, extra={"proposals": [dataclasses.asdict(p) for p in ranked], "session": [p.name for p in session]}
    )
    write_json(Path(args.out) / "plan.json", value)
    print(f"references as CSV: {args.out}")
    print(f"sweeps that autopilots fly by themselves: {', '.join(path.name for path in excitation.write(args.out))}")
    if args.json:
        write_json(args.json, value)
    return 0
