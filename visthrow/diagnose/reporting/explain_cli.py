"""``visthrow diagnose explain``: what the model gets wrong about measured flights."""

import argparse
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any

from visthrow.diagnose.inputs import model_arguments as opening
from visthrow.diagnose.select.result import INCONSISTENT, OUT_OF_DOMAIN, Diagnosis

if TYPE_CHECKING:
    from visthrow.diagnose.models.model_interface import Model
    from visthrow.diagnose.reporting.gain import Gain
    from visthrow.logs.flightlog import FlightLog

# exit status where no cause can be named: the data contradict themselves, or the simulation does
# not follow them
REFUSED = 1

DIAGNOSIS = "diagnosis.json"  # in the report's folder; `diagnose apply` reads it


add_arguments = opening.declared_with_logs(__file__)


def run(args: argparse.Namespace) -> int:
    """Read, search, print, write."""
    from visthrow.common.storage import check_place, write_json
    from visthrow.diagnose.reporting import diagnosis_report as report
    from visthrow.view import page

    folder = Path(args.out)
    made_with = opening.made_with(args)
    check_place(folder / DIAGNOSIS)
    opened = opening.Opened(args)
    test_flights = opening.Opened(argparse.Namespace(**{**vars(args), "logs": args.test}))
    (folder / DIAGNOSIS).unlink(missing_ok=True)  # of earlier flights, should this run stop
    diagnosis = opened.diagnose(say=lambda line: print(line, flush=True))
    gain = None
    only_json = args.no_report or diagnosis.work is None
    if only_json:
        write_json(folder / DIAGNOSIS, report.to_json(diagnosis, extra=made_with))
        print("\n" + report.summary(diagnosis))
    else:
        limits = not args.no_blind
        gain = write_report(
            folder, diagnosis, opened.model, opened.logs, args.seed, limits, made_with
        )
    tested = _test(test_flights, diagnosis) if args.test and diagnosis.work is not None else {}
    if only_json:
        print(f"JSON: {folder / DIAGNOSIS}")
        if (folder / page.PAGE).exists():
            print(f"{folder / page.PAGE}, its pictures and recording are of an earlier diagnosis")
    else:
        print(f"page, JSON, pictures and recording: {folder}")
    if args.json:
        extra = {**made_with, "tested": tested}
        write_json(args.json, report.to_json(diagnosis, gain, extra=extra))
    return REFUSED if diagnosis.overall in (INCONSISTENT, OUT_OF_DOMAIN) else 0


def _test(
    test_flights: opening.Opened, diagnosis: Diagnosis
) -> dict[str, tuple[float, float, float]]:
    """Return prediction errors of other flights by the model as its setup has it without
    extensions, by that with all that was found, and of noise alone; print them.
    """
    from visthrow.diagnose.likelihood.forms import readable, unit_of
    from visthrow.diagnose.models.law_terms import Term
    from visthrow.diagnose.reporting.gain import on_others
    from visthrow.diagnose.select.diagnose_flights import refused_of
    from visthrow.logs.check.run import check, contradictions

    checked = check(test_flights.logs, test_flights.known)
    for reason in contradictions(checked, test_flights.known.unread):
        print(f"left out of the tested flights: {reason}")
    after = test_flights.model
    before = after.plain()
    if diagnosis.explanations:
        laws = []
        for law in diagnosis.explanations[0]:
            laws.append(Term(law.block, law.factors, law.vector).law(law.coefficient))
        after = after.with_laws(laws)
    refused = refused_of(checked, test_flights.known)
    tested = on_others(before, after, diagnosis.expected, diagnosis, refused)
    print(
        f"tested on {tested.windows} windows of {tested.flights} of {len(test_flights.logs)} "
        f"flights;"
        f" {tested.outliers} of {tested.samples} samples are outliers, which weigh less"
    )
    for channel, channel_errors in tested.errors.items():
        factor, unit = readable(unit_of(channel))
        plain, named, floor = (factor * x for x in channel_errors)
        won = ""
        if plain > floor:
            won = f", {(plain - named) / (plain - floor):.0%} of what is above it"
        print(
            f"on the tested flights, {channel}: {plain:.3g} -> {named:.3g} {unit}, noise alone"
            f" {floor:.3g}{won}"
        )
    return tested.errors


def write_report(
    folder: Path,
    diagnosis: Diagnosis,
    model: "Model",
    logs: "Sequence[FlightLog]",
    seed: int,
    limits: bool = True,
    made_with: Mapping[str, Any] | None = None,
) -> "Gain | None":
    """Print the summary, write JSON, page, pictures and recording; returns the gain on held-out
    flights.

    ``made_with``: see :func:`visthrow.diagnose.inputs.model_arguments.made_with`.
    """
    from visthrow.common import provenance
    from visthrow.common.storage import write_json
    from visthrow.diagnose.reporting import blackbox, blind, gain, recording
    from visthrow.diagnose.reporting import diagnosis_report as report
    from visthrow.diagnose.select import result
    from visthrow.view import page

    gained = gain.measure(diagnosis, seed=seed)
    # windows of one sample have nothing ahead that could be predicted
    measured = gained if gained.channels else None
    hidden = blind.hide(diagnosis, seed=seed) if limits else None
    steps = model.step_error()
    origin = provenance.collect()
    source = {"logs": len(logs)} | {key: origin[key] for key in ("command", "commit", "time")}
    table = None
    if diagnosis.overall == result.UNKNOWN:
        table = blackbox.unexplained(diagnosis.work.after, seed)
    extra = {**(made_with or {}), "step_error_sigma": steps, "provenance": origin, "table": table}
    whole = report.to_json(diagnosis, measured, hidden, extra=extra)
    write_json(folder / DIAGNOSIS, whole)  # before pictures, which a full disk may refuse
    print("\n" + report.summary(diagnosis, measured))
    parts = report.sections(diagnosis, measured, hidden, step_check=steps, provenance=source)
    page.write(
        folder,
        "What the simulation gets wrong about these flights",
        report.sentence_of(diagnosis),
        parts,
    )
    recording.write(folder / "diagnosis.rrd", diagnosis, logs)
    return measured
