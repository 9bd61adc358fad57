"""Cross-validate the selected effects on held-out flights.

Each flight is left out in turn. The search is repeated on the statistics of the others, and its
result predicts the held-out flight, with gusts integrated out. The set is confirmed if the interval
of its gain there lies above 0. If it holds 0, all its effects become candidates. So do effects that
the repeated searches do not find again. Effects that increase the error are withdrawn. A law
outside the catalogue is kept only if flights that were not used for its coefficient repeat it.
"""

from collections import Counter, defaultdict
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace

import numpy as np
from numpy import ndarray
from scipy.special import stdtrit

from visthrow.diagnose.likelihood.correlation import components
from visthrow.diagnose.likelihood.evidence import FEWEST, NORMAL_95, STRONG, UNKNOWN_RATIO
from visthrow.diagnose.likelihood.forms import HORIZONS, errors, predict, readable, unit_of
from visthrow.diagnose.likelihood.marginal import Statistics
from visthrow.diagnose.models.model_interface import LATENT_BLOCKS, Indices
from visthrow.diagnose.select import result
from visthrow.diagnose.select.candidates import (
    DAY,
    FLIGHT,
    NOTHING,
    Names,
    columns_of,
    integrate_shares,
    list_shared,
)
from visthrow.diagnose.select.excess import LANDING, compares_phases, floors_of
from visthrow.diagnose.select.occam import Linear
from visthrow.diagnose.select.occam import window as occam_window
from visthrow.diagnose.select.point import Point, Problem
from visthrow.diagnose.select.result import ChannelGain, Diagnosis, Finding, HeldOut, Level

MOST_FOLDS = 12
FIRM = 1.0 - 1.0 / FEWEST
"""An effect, or another of its class, must be selected in more than this share of the folds; with
``FEWEST`` folds, in all of them.
"""
MOSTLY = 0.6  # share of the residual above which it is attributed to one axis or one flight


@dataclass(frozen=True)
class Crossed:
    """Repeated searches, each without some groups of windows (flights)."""

    groups: list[int]  # group of each window
    left_out: str  # what the groups are
    statistics: Statistics  # by group
    folds: list[ndarray]  # rows of the statistics that are left out together
    trained: ndarray  # sizes for each group from the searches without it, in floors, shape (F, K)
    named: Mapping[str, float]  # effect -> share of the folds that selected it


@dataclass(frozen=True)
class Work:
    """Points before and after a selection, for gain, report, plan and blind limits."""

    before: Point  # nothing selected
    after: Point  # with the selected effects
    active: tuple[int, ...]
    crossed: Crossed | None = None  # the cross-validation, if done
    candidates: tuple[int, ...] = ()  # effects that were free when the active ones were estimated

    @property
    def problem(self) -> Problem:
        """Return the problem of both."""
        return self.after.problem


def groups_of(point: Point) -> tuple[list[int], str]:
    """Return the group of each window for cross-validation, and what the groups are: flights, or
    thirds of flights if there are few.
    """
    flights = [w.flight for w in point.windows]
    if len(set(flights)) >= FEWEST or len(flights) < FEWEST:
        return flights, "flights"
    groups = []
    for i, flight in enumerate(flights):
        part = FEWEST * flights[:i].count(flight) // flights.count(flight)
        groups.append(flight * FEWEST + part)
    return groups, "parts of flights"


def cross_validate(diagnosis: Diagnosis) -> Crossed:
    """Repeat a selection without each of the flights, by the statistics, unless that was done.

    Random shares are integrated out. Candidates are free, as in the diagnosis, but their sizes are
    not used for the prediction."""
    work = diagnosis.work
    if work.crossed is not None:
        return work.crossed
    priors = work.problem.priors
    point = work.after
    effects = work.problem.effects
    groups, left_out = groups_of(point)
    shares = {}  # as if every flight were a day
    for c, size in point.shares.items():
        shares[replace(c, group=FLIGHT) if c.group == DAY else c] = size
    statistics = integrate_shares(point.by_window.sum_by(groups), shares)
    count = len(statistics.flights)
    folds = [np.arange(count)[k::MOST_FOLDS] for k in range(min(count, MOST_FOLDS))]
    trained = np.zeros((count, len(priors.floor)))
    named = Counter()
    offered = list_shared(effects)
    selected = frozenset(offered[j] for j in work.active)

    def penalty(chosen: Names) -> float:
        return sum(diagnosis.threshold + c.penalty for c in chosen)

    for fold in folds:
        training = np.setdiff1d(np.arange(count), fold)
        if not len(training):
            continue
        linear = Linear(statistics.only(training), priors, offered, penalty)
        window_sets = occam_window(linear, {NOTHING, selected}, selected, pairs=False)
        chosen = max(window_sets, key=window_sets.get)
        if window_sets[chosen] < linear.value(selected) + STRONG:
            chosen = selected  # it is nearly as good as the best set of the training flights
        written = [j for j in columns_of(chosen) if j not in work.candidates]
        value = linear.value(chosen)
        behind = {s: value - v for s, v in window_sets.items()} | {chosen: 0.0}
        sets = []
        for possible, nats in behind.items():
            if nats < STRONG:
                sets.append(((*columns_of(possible), *work.candidates), nats))
        trained[fold] = linear.total(chosen).mean_sizes(written, sets)
        named.update(columns_of(chosen))
    shares = {effects[j].name: n / len(folds) for j, n in named.items()}
    return Crossed(groups, left_out, statistics, folds, trained, shares)


def count_telling(promised: ndarray) -> ndarray:
    """Return the number of informative flights: those whose predicted gain is strong, or at least
    as large as the mean flight's.

    ``promised``: predicted gain of each flight [nats], shape (F, ...); the result has shape
    (...)."""
    return (promised >= np.minimum(STRONG, promised.mean(0))).sum(0)


def compare_gains(
    statistics: Statistics, trained: ndarray, theta: ndarray
) -> tuple[float, float, float]:
    """Return the ratio of actual to predicted gain on held-out flights, with a 95 % interval.

    The predicted gain is theta' I theta / 2 nats. The ratio exceeds 1 if effects below their floors
    act in the same direction.

    ``trained``: sizes from the other flights, in floors, shape (F, K); ``theta``: sizes from all
    flights, shape (K,)."""
    promised = 0.5 * theta @ statistics.information @ theta
    brought = 0.5 * (statistics.absolute.square - statistics.extrapolate(trained).square)
    return share_of(promised, brought)


def share_of(promised: ndarray, brought: ndarray) -> tuple[float, float, float]:
    """Return the ratio of actual to predicted gain, with a 95 % interval.

    For the true size, the actual gain has the predicted one as its mean and twice that as its
    variance. ``promised``, ``brought``: predicted and actual gain of each flight [nats], shape
    (F,)."""
    total = float(promised.sum())
    if total <= 0.0:
        return 0.0, np.nan, np.nan
    value = float(brought.sum()) / total
    influence = (brought - value * promised) / total
    reach = _reach(influence, promised, np.sqrt(2.0 / total))
    return value, value - reach, value + reach


def _reach(influence: ndarray, promised: ndarray, deviation: float) -> float:
    """Return half the width of a 95 % interval: Student's from the scatter of the informative
    flights, or that of noise alone if it is wider; NaN if fewer than two are informative.

    ``influence``: of each flight on the estimate, shape (F,); ``promised``: predicted gain of each
    [nats]; ``deviation``: of the estimate by noise alone."""
    n = count_telling(promised)
    if n < 2 or promised.sum() <= 0.0:
        return np.nan
    scatter = np.sqrt(n / (n - 1.0) * (influence**2).sum())
    return float(max(stdtrit(n - 1, 0.975) * scatter, NORMAL_95 * deviation))


def channel_gains(
    work: Work, groups: Indices, trained: ndarray, box: ndarray | None = None
) -> tuple[ChannelGain, ...]:
    """Return the prediction errors of every measured channel on held-out flights.

    ``groups``: held-out group of each window; ``trained``: sizes from the other groups, in floors,
    shape (F, K); ``box``: squared errors of a black box, shape (F, C, H)."""
    before = work.before
    after = work.after
    names = work.problem.model.channels
    row = np.unique(groups, return_inverse=True)[1]
    floors = work.problem.priors.floor
    change = (after.theta - trained)[row] * floors
    named = [w.residual + w.effects @ shift for w, shift in zip(after.windows, change)]
    shifts = [w.effects @ (after.theta * floors) for w in after.windows]
    plain = [w.residual for w in before.windows]
    left = errors(after.windows, groups, after.noise, named, len(names))
    promised = errors(after.windows, groups, after.noise, shifts, len(names)).square
    earlier = errors(before.windows, groups, after.noise, plain, len(names)).square
    if box is None:
        box = np.full_like(earlier, np.nan)
    # before, after, of noise alone, of the black box, and of the change by the effects: (5, F, C,
    # H)
    squares = np.stack((earlier, left.square, left.floor, box, promised))
    gains = []
    for c, name in enumerate(names):
        count = left.count[:, c]
        if count.sum() > 0:
            gains.append(_channel(name, after.sigma(c), count, squares[:, :, c]))
    return tuple(gains)


def _channel(name: str, sigma: float, count: ndarray, squares: ndarray) -> ChannelGain:
    """Return the gain of a channel; ``count``: samples by flight and horizon, shape (F, H);
    ``squares``: sums before, after, of noise alone, of the black box and of the change by the
    effects, by flight and horizon, shape (5, F, H).
    """
    by_flight = squares.sum(2)
    samples = count.sum(0)
    by_horizon = np.maximum(squares.sum(1), 0.0)
    totals = np.maximum(by_flight.sum(1), 0.0)
    before, after, floor, box, _ = (sigma * np.sqrt(totals / samples.sum())).tolist()
    value, low, high = gain_of(by_flight[0], by_flight[1], by_flight[4], count.sum(1))
    measured = samples > 0
    curves = np.sqrt(by_horizon[:3, measured] / samples[measured])
    rows = np.vstack((np.array(HORIZONS)[measured], curves)).T.tolist()
    errors_of = before, after, min(floor, after), box
    return ChannelGain(name, unit_of(name), *errors_of, value, low, high, tuple(map(tuple, rows)))


def gain_of(
    before: ndarray, after: ndarray, promised: ndarray, count: ndarray
) -> tuple[float, float, float]:
    """Return the gain 1 - sqrt(sum after / sum before) with a 95 % interval.

    Flights excite an effect unequally, and errors of other origin remain in each. So the decrease
    in a flight is compared with the predicted one, and the remaining error with the number of
    samples.

    Args:
        before: sums of squares by flight, in sigmas, shape (F,).
        after: the same after the effects were applied, shape (F,).
        promised: sums of squares of the change by the effects, shape (F,).
        count: number of samples, shape (F,).

    Source: the delta method for log(after / before), van der Vaart 1998, ch. 3.
    """
    old = before.sum()
    left = after.sum()
    total = promised.sum()
    if old <= 0.0 or left <= 0.0:
        return 0.0, np.nan, np.nan
    fall = before - after
    rest = after - left * count / count.sum()
    differing = fall - fall.sum() * promised / max(total, 1e-300)
    # influence of each flight on log(after / before)
    influence = (fall.sum() / left * rest - differing) / old
    # by noise alone, a decrease has 4 times the predicted one as its variance
    reach = _reach(influence, 0.5 * promised, np.sqrt(4.0 * total) / old)
    value = np.log(left / old)
    return tuple((1.0 - np.exp(0.5 * (value + np.array([0.0, reach, -reach])))).tolist())


def measure(diagnosis: Diagnosis) -> HeldOut:
    """Cross-validate the effects of a diagnosis."""
    work = diagnosis.work
    cross = cross_validate(diagnosis)
    floors = work.problem.priors.floor
    sizes = np.array([diagnosis.theta.get(e.name, 0.0) for e in work.problem.effects])
    share = compare_gains(cross.statistics, cross.trained, sizes / floors)
    gains = channel_gains(work, cross.groups, cross.trained)
    return HeldOut(*share, gains, cross.named, len(cross.folds), cross.left_out)


@dataclass(frozen=True)
class Doubt:
    """A reason to change the verdict on some effects."""

    names: Sequence[str] = ()
    verdict: str = result.CANDIDATE  # new verdict
    why: str = ""  # appended to the sentence of each finding
    reason: str = ""  # of the overall verdict, if no effect remains


def judge(diagnosis: Diagnosis) -> Diagnosis:
    """Return the diagnosis with the effects that held-out flights confirm."""
    if diagnosis.overall == result.NO_EFFECT:
        return _innovations(diagnosis)
    spanning = [n for n in diagnosis.theta if diagnosis[n].low <= 0.0 <= diagnosis[n].high]
    reason = f"{', '.join(spanning)}: every interval holds 0"
    diagnosis = _withdrawn(diagnosis, Doubt(spanning, why="its interval holds 0", reason=reason))
    rivalled = [n for n in diagnosis.theta if diagnosis[n].verdict == result.CANDIDATE]
    why = "sets of causes without it explain these flights nearly as well"
    reason = (
        f"{', '.join(rivalled)}: sets of causes without them explain these flights nearly as well"
    )
    diagnosis = _withdrawn(diagnosis, Doubt(rivalled, why=why, reason=reason))
    while diagnosis.theta and diagnosis.overall in (result.KNOWN, result.UNKNOWN):
        diagnosis = replace(
            diagnosis, work=replace(diagnosis.work, crossed=cross_validate(diagnosis))
        )
        diagnosis = replace(diagnosis, held_out=measure(diagnosis))
        doubt = _doubt(diagnosis, diagnosis.held_out)
        if not doubt.names:
            return _explain(diagnosis)
        diagnosis = _withdrawn(diagnosis, doubt)
    return diagnosis


def _doubt(diagnosis: Diagnosis, measured: HeldOut) -> Doubt:
    """Return the effects that held-out flights contradict or do not confirm, or that the repeated
    searches do not find again.
    """
    uncompared = not compares_phases(diagnosis.work.after)
    return (
        _harm(diagnosis, measured, uncompared)
        or _no_confirmation(diagnosis, measured, uncompared)
        or _disagreement(diagnosis, measured)
    )


def _harm(diagnosis: Diagnosis, measured: HeldOut, uncompared: bool) -> Doubt | None:
    """Return a doubt if the effects increase the error of held-out flights.

    ``uncompared``: whether there is no calm phase to compare with."""
    harmed = [c for c in measured.channels if uncompared and c.high < 0.0]
    if measured.share > 0.0 and not harmed:
        return None
    borne = share_text(measured.share, measured.low, measured.high)
    how = ", ".join(f"{c.channel} by {-100 * c.gain:.0f} %" for c in harmed) or borne
    names = ", ".join(diagnosis.theta)
    reason = f"held-out {measured.left_out} are predicted worse with {names} ({how}); withdrawn"
    why = "held-out flights are predicted worse with it"
    return Doubt(diagnosis.named, result.NOT_IDENTIFIABLE, why, reason)


def _no_confirmation(diagnosis: Diagnosis, measured: HeldOut, uncompared: bool) -> Doubt | None:
    """Return a doubt if held-out flights do not confirm the effects, or no channel's error
    falls.
    """
    falls = [c.low if uncompared else c.gain for c in measured.channels]
    fallen = not falls or any(fall > 0.0 for fall in falls)
    if measured.low > 0.0 and fallen:
        return None
    failed = share_text(measured.share, measured.low, measured.high)
    if measured.low > 0.0:
        failed = _no_gain(measured)
    names = ", ".join(diagnosis.theta)
    reason = f"held-out {measured.left_out} do not confirm {names} ({failed})"
    if np.isnan(measured.low) or measured.folds < FEWEST:
        reason += f"; {_one_more(diagnosis, diagnosis.named)}"
    return Doubt(diagnosis.named, why="held-out flights do not confirm it", reason=reason)


def _disagreement(diagnosis: Diagnosis, measured: HeldOut) -> Doubt:
    """Return the doubt about effects that searches without some flights do not find again."""
    unsure = []
    for name in diagnosis.theta:  # another of its class counts as well
        alike = (name, *diagnosis[name].partners)
        if sum(measured.named_in.get(member, 0.0) for member in alike) < FIRM + 1e-9:
            unsure.append(name)
    why = f"the search, repeated without some {measured.left_out}, does not always select it"
    reason = f"searches that leave {measured.left_out} out do not select the same effects"
    return Doubt(unsure, why=why, reason=reason)


def _explain(diagnosis: Diagnosis) -> Diagnosis:
    """Add the reasons of a confirmed diagnosis: how much of the error remains."""
    if diagnosis.overall == result.UNKNOWN:
        return diagnosis
    gains = diagnosis.held_out.channels
    unexplained = [] if compares_phases(diagnosis.work.after) else _find_unexplained(gains)
    if not unexplained:
        return replace(diagnosis, reasons=(_describe_known(diagnosis),))
    reasons = tuple(_describe_remaining(c, diagnosis.work) for c in unexplained)
    return replace(diagnosis, overall=result.IN_PART, reasons=reasons)


def _describe_known(diagnosis: Diagnosis) -> str:
    """Describe how many effects were found, and the remaining error on held-out flights."""
    text = f"{len(diagnosis.theta)} named"
    unsure = [f for f in diagnosis.findings if f.verdict == result.CANDIDATE]
    candidates = {frozenset((f.name, *f.partners)) for f in unsure}
    if candidates:
        text += f", {len(candidates)} candidate{'s' if len(candidates) > 1 else ''} besides"
    gains = diagnosis.held_out.channels
    ratios = {c.channel: c.after / c.floor for c in gains if c.floor > 0.0}
    if not ratios:
        return text
    worst = max(ratios, key=ratios.get)
    ratio = f"{ratios[worst]:.1f}"
    if ratio == "1.0":
        return f"{text}, no residual above the noise"
    return (
        f"{text}; on held-out {diagnosis.held_out.left_out} the error of {worst} is {ratio} times"
        " that of noise alone"
    )


def _find_unexplained(gains: Sequence[ChannelGain]) -> list[ChannelGain]:
    """Return the channels whose remaining error is far above the noise and, for a position, large
    enough to matter for a landing.
    """
    negligible = {"m": LANDING}
    return [c for c in gains if c.after > max(UNKNOWN_RATIO * c.floor, negligible.get(c.unit, 0.0))]


def _innovations(diagnosis: Diagnosis) -> Diagnosis:
    """Check a diagnosis without selected effects: the prediction errors must be near the noise.

    With a calm phase to compare with, excessive latent forces were checked instead."""
    work = diagnosis.work
    point = work.after
    if compares_phases(point):
        return diagnosis
    groups, _ = groups_of(point)
    none = np.zeros((len(set(groups)), len(point.theta)))
    unexplained = _find_unexplained(channel_gains(work, groups, none))
    if not unexplained:
        return diagnosis
    floors = floors_of(point)

    def strength(level: Level) -> float:
        floor = floors.get((LATENT_BLOCKS.index(level.block), level.phase), np.inf)
        return level.after / floor

    block = max(diagnosis.levels, key=strength).block if diagnosis.levels else ""
    reasons = tuple(_describe_remaining(c, work) for c in unexplained)
    return replace(diagnosis, overall=result.UNKNOWN, block=block, reasons=reasons)


def _withdrawn(diagnosis: Diagnosis, doubt: Doubt) -> Diagnosis:
    """Change the verdict on doubted effects and the members of their classes.

    Other effects keep their sizes and deviations. A candidate without evidence at the end of the
    search becomes BOUNDED: initial states and derivatives that were fitted after its selection may
    explain the same.

    If no effect remains, the overall verdict is UNKNOWN, in the block of the effect with most
    evidence."""
    if not doubt.names:
        return diagnosis
    work = diagnosis.work
    remaining = [name for name in diagnosis.theta if name not in doubt.names]
    rows = [row for row, name in enumerate(diagnosis.theta) if name in remaining]
    spread = np.array(diagnosis.covariance)[np.ix_(rows, rows)]
    numbers = {e.name: j for j, e in enumerate(work.problem.effects)}
    work = replace(
        work,
        after=work.after if remaining else work.before,
        active=tuple(numbers[name] for name in remaining),
        crossed=None,
        candidates=(*work.candidates, *(numbers[name] for name in doubt.names)),
    )
    left = replace(
        diagnosis,
        findings=_doubt_findings(diagnosis, doubt, remaining),
        theta={name: diagnosis.theta[name] for name in remaining},
        covariance=tuple(map(tuple, spread.tolist())),
        work=work,
    )
    if remaining:
        return left
    strongest = max((diagnosis[name] for name in doubt.names), key=lambda f: f.nats)
    block = diagnosis.block or strongest.block
    earlier = diagnosis.reasons if diagnosis.overall == result.UNKNOWN else ()
    reasons = (doubt.reason, *earlier)
    return replace(left, overall=result.UNKNOWN, block=block, reasons=reasons)


def _doubt_findings(
    diagnosis: Diagnosis, doubt: Doubt, remaining: Sequence[str]
) -> tuple[Finding, ...]:
    """Return the findings with the new verdict on doubted effects and the members of their classes;
    ``remaining``: other effects.
    """
    partners = [diagnosis[name].partners for name in doubt.names]
    removed = set(doubt.names).union(*partners) - set(remaining)
    findings = []
    for f in diagnosis.findings:
        if f.name in removed and f.verdict in (result.FOUND, result.CLASS):
            sentence = f"{f.sentence} But {doubt.why}."
            f = replace(f, verdict=doubt.verdict, sentence=sentence)
        if f.name in removed and f.verdict == result.CANDIDATE and f.nats <= 0.0:
            f = result.bound(f)
        findings.append(f)
    return tuple(findings)


def share_text(share: float, low: float, high: float) -> str:
    """Return the result of :func:`compare_gains` as a clause about held-out flights."""
    if np.isnan(low):
        return "only one of them is informative"
    return (
        f"they show {100 * share:.0f} % [{100 * low:.0f}, {100 * high:.0f}] of the predicted gain"
    )


def _no_gain(measured: HeldOut) -> str:
    """Return the gains of all channels as text, none of which is certain."""
    gains = (f"{c.channel} {100 * c.gain:.0f} % {c.interval}" for c in measured.channels)
    return f"no channel's error surely decreases: {', '.join(gains)}"


def _one_more(diagnosis: Diagnosis, names: Sequence[str]) -> str:
    """Return the flight to be flown next, as text."""
    manoeuvres = list(dict.fromkeys(m for name in names for m in diagnosis[name].manoeuvres))
    return f"fly once more{f', for example: {manoeuvres[0]}' if manoeuvres else ' like these'}"


def _describe_remaining(c: ChannelGain, work: Work) -> str:
    """Return a sentence about a channel's remaining error and its kind."""
    factor, unit = readable(c.unit)
    text = f"{factor * c.after:.3g} of {factor * c.before:.3g} {unit}".rstrip()
    kind = _kind(work, work.problem.model.channels.index(c.channel))
    return (
        f"{c.channel}: {text} remain on held-out flights, noise alone"
        f" {factor * c.floor:.3g}{f'; {kind}' if kind else ''}"
    )


def _kind(work: Work, channel: int) -> str:
    """Describe a channel's remaining error: mostly in one axis or flight, or growing with time."""
    point = work.after
    windows = [w for w in work.after.windows if np.any(w.channel == channel)]
    by_axis = np.zeros(3)
    by_flight = Counter()
    halves = {False: [], True: []}  # of the flights
    times = defaultdict(list)
    for window in windows:
        times[window.flight].append(window.time.mean())
    for window in windows:
        rows = window.channel == channel
        innovation, _, horizon = predict(window, point.noise, window.residual)
        square = np.where(horizon < 0, 0.0, innovation**2)[rows]
        if components(window, channel) is not None and len(square) % 3 == 0:
            by_axis += square.reshape(-1, 3).sum(0)
        by_flight[window.flight] += square.sum()
        of_flight = times[window.flight]
        middle = 0.5 * (min(of_flight) + max(of_flight))
        halves[window.time.mean() > middle] += square.tolist()
    parts = []
    if by_axis.max(initial=0.0) > MOSTLY * by_axis.sum() > 0.0:
        parts.append(f"mostly along {'xyz'[by_axis.argmax()]}")
    if len(by_flight) > 2 and max(by_flight.values()) > MOSTLY * sum(by_flight.values()):
        parts.append(f"mostly in flight {max(by_flight, key=by_flight.get)}")
    first, second = (np.sqrt(np.sum(half) / max(len(half), 1)) for half in halves.values())
    if second > 1.5 * first > 0.0:
        parts.append("growing within the flight")
    return ", ".join(parts)


def repeated_share(point: Point, laws: Indices) -> tuple[float, float, float]:
    """Return the ratio of actual to predicted gain of laws on held-out flights, with its 95 %
    interval; effects keep their sizes from all flights.

    ``laws``: indices of the laws' terms among the effects."""
    statistics = point.by_window.sum_by(groups_of(point)[0])
    count = len(point.problem.model.effects)
    names = np.where(np.arange(len(point.theta)) < count, point.theta, 0.0)
    rows = statistics.information[:, laws]
    information = rows[:, :, laws]
    score = statistics.extrapolate(names).score[:, laws]
    prior = np.diag(point.problem.priors.slab[laws] ** -2.0)
    total = information.sum(0) + prior
    other_information = total - information
    other_score = score.sum(0) - score
    trained = np.linalg.solve(other_information, other_score[..., None])[..., 0]
    none = np.zeros(len(laws))
    part = replace(statistics, information=information, score=score, theta=none)
    return compare_gains(part, trained, np.linalg.solve(total, score.sum(0)))
