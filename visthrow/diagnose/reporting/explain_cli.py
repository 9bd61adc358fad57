"""``visthrow diagnose explain``: what the model gets wrong about measured flights."""

import argparse
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

from visthrow.common import provenance
from visthrow.common.arguments import declare
from visthrow.common.storage import check_place, write_json
from visthrow.diagnose.inputs import model_arguments as opening
from visthrow.diagnose.likelihood.forms import readable, unit_of
from visthrow.diagnose.models.model_interface import Model
from visthrow.diagnose.reporting import blackbox, blind, gain
from visthrow.diagnose.reporting import diagnosis_report as report
from visthrow.diagnose.select.diagnose_flights import find_refused
from visthrow.diagnose.select.result import INCONSISTENT, OUT_OF_DOMAIN, UNKNOWN, Diagnosis
from visthrow.logs.check.run import check, contradictions
from visthrow.logs.flightlog import FlightLog
from visthrow.view import page

# exit status if no effect can be selected: the data contradict themselves, or the simulation fails
# to follow them
REFUSED = 1

DIAGNOSIS = "diagnosis.json"  # in the report's folder; `diagnose apply` reads it


add_arguments = declare(opening.__file__, __file__)


def run(args: argparse.Namespace) -> int:
    """Diagnose the flights, print the summary, and write the report."""
    folder = Path(args.out)
    made_with = opening.describe_origin(args)
    check_place(folder / DIAGNOSIS)
    opened = opening.Opened(args)
    test_flights = opening.Opened(argparse.Namespace(**{**vars(args), "logs": args.test}))
    (folder / DIAGNOSIS).unlink(missing_ok=True)  # an interrupted run leaves no old result behind
    diagnosis = opened.diagnose(say=lambda line: print(line, flush=True))
    gained = None
    if args.no_report or diagnosis.work is None:
        write_json(folder / DIAGNOSIS, report.to_json(diagnosis, extra=made_with))
        print("\n" + report.summary(diagnosis))
        written = f"JSON: {folder / DIAGNOSIS}"
        stale = folder / page.PAGE
        if stale.exists():
            written += f"\n{stale}, its pictures and recording are of an earlier diagnosis"
    else:
        limits = not args.no_blind
        gained = write_report(
            folder, diagnosis, opened.model, opened.logs, args.seed, limits, made_with
        )
        written = f"page, JSON, pictures and recording: {folder}"
    tested = _test(test_flights, diagnosis) if args.test and diagnosis.work is not None else {}
    print(written)
    if args.json:
        extra = {**made_with, "tested": tested}
        write_json(args.json, report.to_json(diagnosis, gained, extra=extra))
    return REFUSED if diagnosis.overall in (INCONSISTENT, OUT_OF_DOMAIN) else 0


def _test(
    test_flights: opening.Opened, diagnosis: Diagnosis
) -> dict[str, tuple[float, float, float]]:
    """Return and print the prediction errors on unseen flights, by channel: of the setup's model
    without extensions, of the model with all effects and laws that were found, and of noise alone.
    """
    checked = check(test_flights.logs, test_flights.known)
    for reason in contradictions(checked, test_flights.known.unread):
        print(f"left out of the tested flights: {reason}")
    after = test_flights.model
    before = after.plain()
    if diagnosis.explanations:
        after = after.with_laws(diagnosis.explanations[0])
    refused = find_refused(checked, test_flights.known)
    tested = gain.evaluate_on_others(before, after, diagnosis.expected, diagnosis, refused)
    print(
        f"tested on {tested.windows} windows of {tested.flights} of {len(test_flights.logs)} "
        f"flights;"
        f" {tested.outliers} of {tested.samples} samples are outliers and have less weight"
    )
    for channel, channel_errors in tested.errors.items():
        factor, unit = readable(unit_of(channel))
        plain, named, floor = (factor * x for x in channel_errors)
        won = ""
        if plain > floor:
            won = f", {(plain - named) / (plain - floor):.0%} of the excess over noise is removed"
        print(
            f"on the tested flights, {channel}: {plain:.3g} -> {named:.3g} {unit}, noise alone"
            f" {floor:.3g}{won}"
        )
    return tested.errors


def write_report(
    folder: Path,
    diagnosis: Diagnosis,
    model: Model,
    logs: Sequence[FlightLog],
    seed: int,
    limits: bool = True,
    made_with: Mapping[str, Any] | None = None,
) -> gain.Gain | None:
    """Print the summary, and write JSON, page, pictures and recording.

    ``limits``: whether to compute the detection limits; ``made_with``: see
    :func:`visthrow.diagnose.inputs.model_arguments.describe_origin`. Returns the gain on held-out
    flights; None where no window can be predicted.
    """
    from visthrow.diagnose.reporting import recording

    gained = gain.measure(diagnosis, seed=seed)
    # windows of one sample have no later sample to predict
    measured = gained if gained.channels else None
    hidden = blind.hide(diagnosis, seed=seed) if limits else None
    steps = model.step_error()
    origin = provenance.collect()
    source = {"logs": len(logs)} | {key: origin[key] for key in ("command", "commit", "time")}
    table = None
    if diagnosis.overall == UNKNOWN:
        table = blackbox.tabulate_unexplained(diagnosis.work.after, seed)
    extra = {**(made_with or {}), "step_error_sigma": steps, "provenance": origin, "table": table}
    whole = report.to_json(diagnosis, measured, hidden, extra=extra)
    write_json(folder / DIAGNOSIS, whole)  # first, because a full disk may prevent the pictures
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
