"""What the named causes are worth on flights that were not used to find them.

Each flight is left out in turn; the search is repeated on the others by their statistics, and its answer predicts the one left out.
Beside it stand the noise floor, which cannot be beaten, and a black box trained on the same flights.
"""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace

import numpy as np
from scipy.special import stdtrit

from visthrow.diagnose.likelihood import designs
from visthrow.diagnose.likelihood import noise as levels
from visthrow.diagnose.likelihood.evidence import Priors, additions, estimate, log_evidence
from visthrow.diagnose.likelihood.marginal import Statistics, gather, gram_of, window_statistics
from visthrow.diagnose.models.interface import Model
from visthrow.diagnose.reporting.blackbox import table_of, train
from visthrow.diagnose.reporting.forms import HORIZONS, Forms, forms, unit_of
from visthrow.diagnose.reporting.landing_gain import LandingGain, landing_gain
from visthrow.diagnose.select.point import Point
from visthrow.diagnose.select.result import Diagnosis

DRAWS = 10_000
MOST_FOLDS = 12
FEWEST_FLIGHTS = 3
"""With fewer, parts of flights are left out instead, and the report says so."""
PARTS = 3
FEW_GROUPS = 8
MOST_NAMES = 6
HARM = 0.01


@dataclass(frozen=True)
class ChannelGain:
    """Prediction error on held-out flights of one channel; root mean squares in ``unit``."""

    channel: str
    unit: str
    before: float
    after: float
    floor: float  # of sensor noise and of the initial state's uncertainty
    blackbox: float  # NaN where none can be trained
    gain: float  # 1 - after / before
    low: float  # 95 % interval of the gain, by bootstrap over flights
    high: float
    horizons: tuple[tuple[float, float, float, float], ...]  # horizon [s], before, after, floor, in sigmas

    @property
    def harmed(self) -> bool:
        """Whether the prediction got worse by more than a per cent."""
        return self.after > (1.0 + HARM) * self.before


@dataclass(frozen=True)
class Gain:
    """The worth of the named causes."""

    channels: tuple[ChannelGain, ...]
    nats_per_sample: float  # of held-out log-likelihood
    named_in: dict[str, float] = field(default_factory=dict)  # effect -> share of folds that named it
    folds: int = 0
    left_out: str = "flights"  # or "parts of flights"
    landing: LandingGain | None = None  # where the model has throws whose landing was seen
    whole: bool = False  # windows have no initial state that would have to be fitted first, and are predicted from end to end

    def __getitem__(self, channel: str) -> ChannelGain:
        return next(c for c in self.channels if c.channel == channel)


def select(information: np.ndarray, score: np.ndarray, priors: Priors, least: float, most: int = MOST_NAMES) -> list[int]:
    """Forward search with backward elimination by the statistics alone."""
    active: list[int] = []
    while len(active) < most:
        gain = additions(information, score, priors, active)
        best = int(np.argmax(gain))
        if gain[best] <= least:
            break
        active.append(best)
        whole = log_evidence(information, score, priors, active)
        for j in list(active[:-1]):
            rest = [k for k in active if k != j]
            if whole - log_evidence(information, score, priors, rest) < least:
                active, whole = rest, log_evidence(information, score, priors, rest)
    return active


def measure(diagnosis: Diagnosis, *, seed: int = 0, draws: int = DRAWS) -> Gain:
    """Measure the gain of a diagnosis on held-out flights.

    Args:
        diagnosis: of :func:`visthrow.diagnose.select.search.explain`.
        seed: of the bootstrap and of the black box's basis.
        draws: of the bootstrap.
    """
    work, rng = diagnosis.work, np.random.default_rng(seed)
    before, after, priors = work.before, work.after, work.problem.priors
    groups, left_out = _groups(after, work.problem.kept)
    statistics = _regrouped(after, groups)
    folds = _folds(len(statistics.flights))
    channels = len(work.problem.model.channels)
    by_effect = [np.hstack((w.residual[:, None], w.effects * priors.floor)) for w in after.windows]
    own = forms(after.windows, groups, after.noise, by_effect, channels)
    plain = forms(before.windows, groups, after.noise, [w.residual[:, None] for w in before.windows], channels)
    combination, named = _cross_validated(statistics, folds, priors, diagnosis.threshold, after.theta)
    error_before, error_after = plain.error(np.ones(1)), own.error(combination)
    box = _blackbox(before, groups, folds, after, channels, rng)
    nats = _nats(before, statistics, groups, combination)
    shares = {work.problem.model.effects[j].name: n / len(folds) for j, n in named.items()}
    gains = tuple(
        _channel(name, c, after, own, error_before[:, c], error_after[:, c], None if box is None else box[:, c], rng, draws)
        for c, name in enumerate(work.problem.model.channels)
        if own.count[:, c].sum() > 0
    )
    sizes = (after.theta - combination[:, 1:]) if left_out == "flights" and diagnosis.theta else ()
    trained = {int(f): work.problem.sizes(size) for f, size in zip(own.groups, sizes)}
    landing = landing_gain(work, diagnosis.theta, trained, seed)
    whole = all(w.nuisance.shape[1] == 0 for w in after.windows)
    return Gain(gains, nats, shares, len(folds), left_out, landing, whole)


def shortfalls(model: Model, sizes: Sequence[Mapping[str, float]]) -> tuple[list[float], int]:
    """How much worse than by the last of some sizes flights are explained that none of them was found in.

    Initial states and gusts are integrated out (a forecast without gusts would mostly measure those); the levels of noise and
    gusts are those of the last sizes.

    Returns:
        Nats by which each likelihood falls short of the last one, and the number of samples.
    """
    channels, priors = len(model.channels), Priors.of(model.effects, model.channels)
    told = [model.windows(theta) for theta in sizes]
    raw = [[gram_of(w, priors.floor, channels) for w in windows] for windows in told]
    noise, _ = levels.fit(told[-1], raw[-1])
    squares = []
    for windows, grams in zip(told, raw):
        shaped = designs.correlated_of(grams, windows, noise.correlation_time, "cpu")
        squares.append(sum(window_statistics(gram, noise, i).square for i, gram in enumerate(shaped)))
    return [float(0.5 * (square - squares[-1])) for square in squares], sum(len(w.residual) for w in told[-1])


def _groups(point: Point, kept: Sequence[int]) -> tuple[list[int], str]:
    flights = [w.flight for w in point.windows]
    if len(set(flights)) >= FEWEST_FLIGHTS or len(flights) < PARTS:
        return flights, "flights"
    order = {f: [i for i, g in enumerate(flights) if g == f] for f in set(flights)}
    return [f * PARTS + PARTS * order[f].index(i) // len(order[f]) for i, f in enumerate(flights)], "parts of flights"


def _regrouped(point: Point, groups: Sequence[int]) -> Statistics:
    parts = [window_statistics(gram, point.noise, w) for w, gram in enumerate(point.grams)]
    return gather([replace(gram, flight=g) for gram, g in zip(point.grams, groups)], parts, point.theta)


def _folds(count: int) -> list[np.ndarray]:
    return [np.arange(count)[k::MOST_FOLDS] for k in range(min(count, MOST_FOLDS))]


def _cross_validated(
    statistics: Statistics, folds: Sequence[np.ndarray], priors: Priors, least: float, theta: np.ndarray
) -> tuple[np.ndarray, dict[int, int]]:
    """For each group the column combination [1, -(theta_train - theta)] of its fold, and how often each effect was named."""
    combination = np.ones((len(statistics.flights), 1 + len(theta)))
    named: dict[int, int] = {}
    for fold in folds:
        rest = np.setdiff1d(np.arange(len(statistics.flights)), fold)
        active: list[int] = []
        trained = np.zeros(len(theta))
        if len(rest):
            information, score = statistics.information[rest].sum(0), statistics.absolute[rest].sum(0)
            active = select(information, score, priors, least)
            trained = estimate(information, score, priors, active)
        combination[fold, 1:] = theta - trained
        for j in active:
            named[j] = named.get(j, 0) + 1
    return combination, named


def _blackbox(before: Point, groups: Sequence[int], folds, after: Point, channels: int, rng: np.random.Generator):
    """Squared errors of the black box on held-out groups, shape (F, C, H); None where it cannot be trained."""
    table = table_of(before, rng)
    if table is None:
        return None
    trained = train(before, table, groups)
    columns = [np.hstack((w.residual[:, None], w.latent @ table.columns(w))) for w in before.windows]
    own = forms(before.windows, groups, after.noise, columns, channels)
    combination = np.ones((len(own.groups), columns[0].shape[1]))
    for fold in folds:
        rest = np.setdiff1d(np.arange(len(own.groups)), fold)
        combination[fold, 1:] = -trained.weights(rest) if len(rest) else 0.0
    return own.error(combination)


def _nats(before: Point, after: Statistics, groups: Sequence[int], combination: np.ndarray) -> float:
    """Held-out log-likelihood per sample, after minus before, each with its own noise levels."""
    plain = _regrouped(before, groups)
    change = -combination[:, 1:]
    quadratic = np.einsum("fi,fij,fj->f", change, after.information, change)
    square = after.square - 2.0 * np.einsum("fi,fi->f", change, after.score) + quadratic
    return float(0.5 * (plain.square.sum() - square.sum()) / after.samples.sum())


def _channel(name, c, after: Point, own: Forms, before, error, box, rng, draws: int) -> ChannelGain:
    count = own.count[:, c].sum()
    rows = [w.sigma[w.channel == c] for w in after.windows if np.any(w.channel == c)]
    sigma = float(np.median(np.concatenate(rows)))

    def rms(square: np.ndarray) -> float:
        return float(np.sqrt(np.maximum(square.sum(), 0.0) / max(count, 1.0)) * sigma)

    value, low, high = studentised(before.sum(1), error.sum(1), rng, draws)
    by_horizon = own.count[:, c].sum(0)
    seen = by_horizon > 0
    curves = [np.sqrt(np.maximum(x.sum(0)[seen], 0.0) / by_horizon[seen]) for x in (before, error, own.floor[:, c])]
    horizons = tuple((h, *map(float, row)) for h, *row in zip(np.array(HORIZONS)[seen].tolist(), *curves))
    return ChannelGain(name, unit_of(name), rms(before), rms(error), rms(own.floor[:, c]),
                       float("nan") if box is None else rms(box), value, low, high, horizons)  # fmt: skip


def studentised(before: np.ndarray, after: np.ndarray, rng: np.random.Generator, draws: int) -> tuple[float, float, float]:
    """Gain 1 - sqrt(sum after / sum before) with a 95 % interval by the studentised bootstrap over groups.

    Of few groups many resamples hold little else than one of them, and say nothing of the spread: there it is Student's interval.

    Args:
        before: sums of squares by group, shape (F,).
        after: the same afterwards.
        rng: for the draws.
        draws: number of bootstrap samples.

    Source: Efron and Tibshirani 1993, ch. 12, on the logarithm of the ratio.
    """
    n = len(before)
    if before.sum() <= 0.0 or after.sum() <= 0.0:
        return 0.0, float("nan"), float("nan")
    value = np.log(after.sum() / before.sum())
    if n < 2:
        return float(1.0 - np.exp(0.5 * value)), float("nan"), float("nan")

    def spread(w: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        a, b = w @ after, w @ before
        influence = after / a[:, None] - before / b[:, None]
        return np.log(a / b), np.sqrt(n / (n - 1.0) * (w * influence**2).sum(1))

    _, own = spread(np.ones((1, n)))
    if n < FEW_GROUPS:
        reach = 0.5 * stdtrit(n - 1, 0.975) * own[0]
        return tuple(float(1.0 - np.exp(0.5 * value + side)) for side in (0.0, reach, -reach))
    weights = rng.multinomial(n, np.full(n, 1.0 / n), size=draws)
    usable = weights @ before > 0.0
    ratio, error = spread(weights[usable])
    t = (ratio - value) / np.maximum(error, 1e-3 * own[0] + 1e-300)
    upper, lower = np.quantile(t, (0.025, 0.975))
    low, high = 1.0 - np.exp(0.5 * (value - upper * own[0])), 1.0 - np.exp(0.5 * (value - lower * own[0]))
    return float(1.0 - np.exp(0.5 * value)), float(low), float(high)


def bootstrap_sizes(statistics: Statistics, priors: Priors, active: Sequence[int], rng: np.random.Generator, draws: int = DRAWS):
    """Sizes of the named effects in resampled flights, in floors, shape (draws, named)."""
    at, n = list(active), len(statistics.flights)
    weights = rng.multinomial(n, np.full(n, 1.0 / n), size=draws).astype(float)
    own = statistics.information[:, at][:, :, at]
    normal = np.einsum("df,fij->dij", weights, own) + np.diag(priors.slab[at] ** -2.0)
    return np.linalg.solve(normal, (weights @ statistics.absolute[:, at])[:, :, None])[:, :, 0]
