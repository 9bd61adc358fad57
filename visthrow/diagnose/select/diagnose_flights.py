"""Diagnose a model by measured flights: check the flights, select effects, judge them."""

import time
from collections.abc import Callable, Sequence
from dataclasses import replace

import numpy as np

from sim.params import PlantParams
from visthrow.common.errors import DiagnoseError
from visthrow.diagnose.likelihood.evidence import VERY_STRONG, threshold
from visthrow.diagnose.likelihood.marginal import finite
from visthrow.diagnose.models.model_interface import Indices, Model
from visthrow.diagnose.select import held_out, lost_commands
from visthrow.diagnose.select.candidates import ALL, NOTHING, Names, Scatter
from visthrow.diagnose.select.point import (
    ROUNDS,
    SMALL_STEP,
    Point,
    Problem,
    linearise,
    move,
    only,
    untracked_windows,
)
from visthrow.diagnose.select.result import IN_PART, INCONSISTENT, UNKNOWN, Diagnosis
from visthrow.diagnose.select.selection import Selector
from visthrow.diagnose.select.verdicts import conclude, report_out_of_domain
from visthrow.diagnose.throw import command_mistakes as interface
from visthrow.diagnose.throw.command_mistakes import Mistake
from visthrow.logs.check.rows import NOTHING as UNKNOWN_VEHICLE
from visthrow.logs.check.rows import KnownVehicle
from visthrow.logs.check.run import Checked, check, contradictions, copies
from visthrow.logs.flightlog import FlightLog


def diagnose(
    flights: Sequence[FlightLog],
    model: Model | Callable[[], Model],
    *,
    vehicle: KnownVehicle = UNKNOWN_VEHICLE,
    seed: int = 0,
    without: Indices = (),
    laws: bool = True,
    progress: Callable[[str], None] | None = None,
) -> Diagnosis:
    """Find what a model gets wrong about flights: check, select, validate, conclude.

    Args:
        flights: logs of measurements.
        model: a simulation of these flights with its catalogue of effects, or a function that
            builds it, which is called after the logs were checked.
        vehicle: known facts about the vehicle, for the checks.
        seed: of the null worlds by which the threshold is calibrated.
        without: indices of flights that are left out.
        laws: whether to search for laws outside the catalogue.
        progress: called with a line of text at each step.

    Returns a verdict for every effect, and an overall one. Raises DiagnoseError: the model returns
    no window or invalid ones."""
    say = progress or (lambda _: None)
    checked = check(flights, vehicle)
    refused = find_refused(checked, vehicle)
    reasons = contradictions(checked, vehicle.unread)
    unread = [text for text in contradictions(checked) if text not in reasons]
    if 2 * len(refused) > len(flights):
        return Diagnosis(INCONSISTENT, "", tuple(reasons), (), {}, (), 0.0)
    model = model() if callable(model) else model
    say(f"{len(flights)} log(s), {len(model.effects)} effects on {', '.join(model.channels)}")
    copied = {i: original for i, original in copies(checked).items() if i not in refused}
    reasons += [f"{checked[i].name}: a copy of another log, which counts once" for i in copied]
    notes = [*model.notes, *(f"left out: {reason}" for reason in reasons)]
    for note in notes:
        say(f"  {note}")
    left_out = {*without, *refused, *copied}
    diagnosis = explain(
        model,
        seed=seed,
        without=tuple(left_out),
        laws=laws,
        progress=lambda line: say(f"  {line}"),
    )
    missing = len(flights) - len(left_out) - diagnosis.flights
    if missing > 0:
        notes.insert(0, f"{missing} of {len(flights)} flights have no window in this answer")
    for log in checked:
        warnings = [row for row in log.rows if (row.topic, row.verdict) == ("thrust", "warn")]
        notes += [f"check: {log.name}: {row.text}" for row in warnings]
    notes += [
        f"check, overruled or of a channel that the model does not read: {text}" for text in unread
    ]
    if (why := model.lawless) and diagnosis.overall in (UNKNOWN, IN_PART):
        notes.append(f"no law outside the catalogue is looked for: {why}")
    return replace(diagnosis, reasons=(*diagnosis.reasons, *notes), duplicates=copied)


def find_refused(
    checked: Sequence[Checked], vehicle: KnownVehicle = UNKNOWN_VEHICLE
) -> tuple[int, ...]:
    """Return the indices of logs in which channels that the model reads contradict each other."""
    return tuple(i for i, log in enumerate(checked) if contradictions([log], vehicle.unread))


def explain(
    model: Model,
    *,
    seed: int = 0,
    without: Indices = (),
    laws: bool = True,
    progress: Callable[[str], None] | None = None,
) -> Diagnosis:
    """Find what the model gets wrong about its flights, without checking the logs.

    Arguments, result and errors are those of :func:`diagnose`."""
    begun = time.monotonic()
    say = progress or (lambda _: None)
    windows = model.windows({})
    if not windows:
        raise DiagnoseError("the model found no stretch of flight to look at in these logs")
    simulated = list(map(finite, windows))
    considered = [i for i, w in enumerate(windows) if w.flight not in without]
    usable = tuple(i for i in considered if simulated[i])
    if 2 * len(usable) < len(considered) or not usable:
        return report_out_of_domain(model, windows, sum(simulated), seed)
    problem = Problem.of(model, windows, usable)
    for c, correlation in problem.correlated.items():
        say(
            f"noise of {model.channels[c]} is correlated over {1e3 * correlation.time:.0f} ms, for"
            f" {correlation.share:.1%} of its variance"
        )
    nominal = linearise(problem, np.zeros(len(model.effects)), windows=windows)
    selection, commands = _search(nominal, seed, say, laws)
    diagnosis = held_out.judge(conclude(selection, commands))
    reasons = diagnosis.reasons
    left_out = len(considered) - len(selection.nominal.windows)
    if left_out:
        reasons += (
            f"{left_out} of {len(considered)} windows are left out, which the simulation does not"
            " follow: a cause that acts in these alone does not show",
        )
    return replace(diagnosis, reasons=reasons, seconds=time.monotonic() - begun, seed=seed)


def _search(
    nominal: Point, seed: int, say: Callable[[str], None], laws: bool
) -> tuple[Selector, Scatter | None]:
    """Select effects and lost commands, and drop windows that the simulation does not follow."""
    begin = NOTHING
    priors = nominal.problem.priors
    for further in range(2 * ROUNDS, -1, -1):
        untracked = untracked_windows(nominal) if further else []  # bad ones may hide others
        if not untracked:
            needed = threshold(nominal.statistics, priors, np.random.default_rng(seed))
            count = f"{len(nominal.windows)} windows of {len(nominal.plain.flights)} flights"
            say(f"{count}; a cause needs {needed:.1f} nats")
            selection, commands = _select(Selector(nominal, needed, say, laws), begin)
            begin = frozenset(c for c in selection.best.chosen if c.group == ALL and not c.law)
            untracked = _find_unfollowed(selection) if further else []
            if not untracked:
                break
        say(f"{len(untracked)} windows are left out, which the simulation does not follow")
        nominal = only(nominal, sorted({*range(len(nominal.windows))} - {*untracked}))
    return selection, commands


def _find_unfollowed(selection: Selector) -> list[int]:
    """Return the windows that the simulation does not follow with the selected effects, at their
    sizes or at those predicted by the derivatives.
    """
    point = selection.best.point
    goal = point.posterior.estimate(selection.best.columns)
    theta = np.where(point.problem.switches, point.theta, goal)
    untracked = untracked_windows(point)
    if untracked or np.abs(theta - point.theta).max() <= SMALL_STEP:
        return untracked
    leads = move(point, theta)
    return untracked_windows(leads) if leads else []


def _select(selector: Selector, begin: Names) -> tuple[Selector, Scatter | None]:
    """Run the selection, and repeat it with lost commands if these may explain more.

    Lost commands are a candidate that needs another linearisation."""
    plain = selector.run(begin)
    nominal = plain.nominal
    needed = plain.threshold
    loss = lost_commands.verdict(nominal, (), needed)
    if not (loss and loss[0].found) and plain.best.columns:
        loss = lost_commands.verdict(plain.best.point, plain.best.columns, needed)
    if not (loss and loss[0].found):
        return plain, None
    share, lost = loss
    lossy = replace(nominal.problem, terms=(), lost=lost)
    start = linearise(lossy, np.zeros(len(lossy.effects)), nominal.noise)
    lossy_selection = Selector(start, needed, plain.progress, plain.laws).run(begin)
    cost = needed + sum(lost_commands.divergence(of, share.size) for of in lost)
    gain = lossy_selection.value - cost - plain.value
    plain.progress(
        f"{share.size:.1%} of commands were lost: {gain:.1f} nats better than without losses"
    )
    if gain <= 0.0:
        return plain, None
    return lossy_selection, share


def correct_interface_mistakes(
    logs: Sequence[FlightLog], plant: PlantParams, build: Callable[[Sequence[FlightLog]], Model]
) -> tuple[Model, list[FlightLog]]:
    """Correct mistakes in the commands of logs, if their evidence exceeds their penalty.

    ``plant``: plant for which the commands are; ``build``: makes a model of logs. Returns the
    model, which lists the corrections as its ``mistakes``, and its logs.
    """
    corrected, certain = interface.derive_commands(logs, plant)
    suspected_mistakes = interface.suspect(corrected, plant)

    def build_corrected(mistakes: Sequence[Mistake]) -> tuple[Model, list[FlightLog]]:
        mended = list(corrected)
        for mistake in mistakes:
            mended = [mistake.mend(log) for log in mended]
        return build(mended), mended

    current = build_corrected(suspected_mistakes)
    for mistake in list(suspected_mistakes):
        remaining = [k for k in suspected_mistakes if k is not mistake]
        try:
            alternative = build_corrected(remaining)
        except DiagnoseError:  # no flight can be replayed without this correction
            continue
        nats = log_bayes_factor(current[0], alternative[0])
        if nats > VERY_STRONG + np.log(mistake.ways):
            suspected_mistakes = [
                replace(k, nats=nats) if k is mistake else k for k in suspected_mistakes
            ]
        else:
            suspected_mistakes = remaining
            current = alternative
    current[0].mistakes = (*certain, *suspected_mistakes)
    return current


def log_bayes_factor(model: Model, rival: Model) -> float:
    """Return the log Bayes factor of a model against a rival, from the windows of both and with no
    effect selected in either.
    """
    windows = [m.windows({}) for m in (model, rival)]
    places = [
        {(w.flight, w.time[0], len(w.time)): i for i, w in enumerate(of_model) if finite(w)}
        for of_model in windows
    ]
    shared = sorted(places[0].keys() & places[1].keys())
    followed, rival_followed = (2 * len(n) >= len(of) for n, of in zip(places, windows))
    if not rival_followed or not shared:  # the rival fails in most of its windows
        return np.inf if followed else -np.inf
    values = []
    for m, of_model, number in zip((model, rival), windows, places):
        problem = Problem.of(m, of_model, [number[key] for key in shared])
        point = linearise(problem, np.zeros(len(m.effects)), windows=of_model)
        values.append(point.evidence(()))
    return values[0] - values[1]
