"""The gain of a diagnosis: how much of the prediction error its effects remove on other flights.

Each flight is held out in turn. The search is repeated on the statistics of the others, and the
effects that it selects predict the held-out flight. The errors are compared with that of noise
alone, which no model can beat, and with that of a black box trained on the same flights."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace

import numpy as np
from numpy import ndarray

from visthrow.common.statistics import mean
from visthrow.diagnose.likelihood.correlation import with_correlations
from visthrow.diagnose.likelihood.forms import FAR_ABOVE, errors, predict
from visthrow.diagnose.likelihood.marginal import Noise, finite, grams_of
from visthrow.diagnose.likelihood.noise_levels import without_outliers
from visthrow.diagnose.models.model_interface import Indices, Model, Sizes, Window
from visthrow.diagnose.reporting.blackbox import table_of, train
from visthrow.diagnose.select.held_out import Crossed, Work, channel_gains, cross_validate
from visthrow.diagnose.select.point import Problem
from visthrow.diagnose.select.result import ChannelGain, Diagnosis


@dataclass(frozen=True)
class LandingGain:
    """Errors of predicted landings without and with the selected effects.

    Lengths in metres; 95 % intervals by bootstrap over throws.
    """

    throws: int
    held_out: bool  # whether each throw was predicted with sizes fitted to the other flights
    # mean distance between predicted and measured landing, open loop from before the throw, of the
    # original model
    before: float
    after: float  # the same with the selected effects
    low: float  # interval of ``after``
    high: float
    released_before: float  # mean distance if predicted from a state fitted up to the separation
    released_after: float
    # selected effect -> mean distance by which it moves the predicted landings
    moved: dict[str, float]
    # predicted minus measured landing of each throw along world x and y, shape (throws, 2)
    off_before: ndarray
    off_after: ndarray


@dataclass(frozen=True)
class Gain:
    """The gain of a diagnosis on held-out flights."""

    channels: tuple[ChannelGain, ...]
    nats_per_sample: float  # increase of the held-out log-likelihood
    named_in: dict[str, float]  # effect -> share of folds that selected it
    folds: int
    left_out: str  # "flights", or "parts of flights"
    landing: LandingGain | None  # None if no landing was measured
    # whether windows are predicted as a whole, because they have no initial state to fit first
    whole: bool

    def __getitem__(self, channel: str) -> ChannelGain:
        return next(c for c in self.channels if c.channel == channel)


def measure(diagnosis: Diagnosis, *, seed: int = 0) -> Gain:
    """Measure the gain of a diagnosis on held-out flights.

    ``diagnosis``: of :func:`visthrow.diagnose.select.diagnose_flights.explain`; ``seed``: of the
    black box's basis."""
    work = diagnosis.work
    cross = cross_validate(diagnosis)
    box = _blackbox(work, cross, np.random.default_rng(seed))
    gains = channel_gains(work, cross.groups, cross.trained, box)
    trained = {}
    if cross.left_out == "flights" and diagnosis.theta:
        for flight, sizes in zip(cross.statistics.flights, cross.trained):
            trained[flight] = work.problem.sizes(sizes)
    landing = landing_gain(work, diagnosis.theta, trained, seed)
    whole = all(w.nuisance.shape[1] == 0 for w in work.after.windows)
    nats = _nats(work, cross)
    return Gain(gains, nats, cross.named, len(cross.folds), cross.left_out, landing, whole)


def landing_gain(
    work: Work, theta: Sizes, trained: Mapping[int, Sizes], seed: int
) -> LandingGain | None:
    """Measure how the selected effects change the errors of predicted landings.

    ``trained``: flight -> sizes fitted to the other flights; empty if no flights were held out.
    Returns None if no landing was measured.
    """
    model = work.problem.model
    flown = sorted({w.flight for w in work.after.windows})
    plain = model.landings({}, flown)
    if plain is None:
        return None
    named = model.landings(theta, flown) if theta else plain
    held_landings = named
    if trained:
        held_landings = plain.join(model.landings(trained[f], [f]) for f in plain.flights)
    good = np.isfinite(plain.errors) & np.isfinite(held_landings.errors)
    if not good.any():
        return None
    moved = {}
    for name in theta:
        remaining = {effect: size for effect, size in theta.items() if effect != name}
        without = model.landings(remaining, flown) if remaining else plain
        level = (named.predicted - without.predicted)[good, :2]
        moved[name] = np.nanmean(np.linalg.norm(level, axis=1))
    after = mean(held_landings.errors[good], seed=seed)
    return LandingGain(
        throws=int(good.sum()),
        held_out=bool(trained),
        before=plain.errors[good].mean(),
        after=after.value,
        low=after.low,
        high=after.high,
        released_before=np.nanmean(plain.released_errors[good]),
        released_after=np.nanmean(held_landings.released_errors[good]),
        moved=moved,
        off_before=plain.off[good],
        off_after=held_landings.off[good],
    )


@dataclass(frozen=True)
class Tested:
    """Prediction errors of a diagnosed model on unseen flights."""

    # channel -> root mean square errors in the channel's unit: of the original model, of the
    # diagnosed one, and of sensor noise and the initial state's uncertainty alone; all components
    # of a channel have equal weight
    errors: dict[str, tuple[float, float, float]]
    flights: int
    windows: int
    samples: int
    outliers: int  # samples that get less weight, as in the fit


def evaluate_on_others(
    before: Model,
    after: Model,
    theta: Sizes,
    diagnosis: Diagnosis,
    without: Indices = (),
) -> Tested:
    """Return the prediction errors on unseen flights.

    Args:
        before: original model of the unseen flights.
        after: diagnosed model of the unseen flights, with the laws that were found.
        theta: sizes of the effects that were found.
        diagnosis: the diagnosis that found them; its noise levels are used.
        without: numbers of the unseen flights to leave out.
    """
    work = diagnosis.work
    scale = np.array([diagnosis.sensor_scale[name] for name in after.channels])
    noise = replace(work.after.noise, scale=scale)
    rms = []
    for model, sizes in ((before, {}), (after, theta)):
        windows = [w for w in model.windows(sizes) if finite(w) and w.flight not in without]
        sums, outliers = _sum_weighted_squares(windows, work.problem, noise)
        rms.append(np.sqrt(sums[:2] / np.maximum(sums[2], 1.0)))
    (plain, _), (named, floor) = rms
    rows = np.column_stack((plain, named, floor))
    errors = {name: tuple(row) for name, row in zip(after.channels, rows)}
    samples = sum(len(w.residual) for w in windows)
    return Tested(errors, len({w.flight for w in windows}), len(windows), samples, outliers)


def _sum_weighted_squares(
    windows: Sequence[Window], problem: Problem, noise: Noise
) -> tuple[ndarray, int]:
    """Return weighted sums over the predicted samples, shape (3, C), and the number of outliers.

    The sums are of squared errors, of the squared errors that noise alone would cause, and of the
    weights; outliers have less weight.
    """
    count = len(noise.scale)
    sums = np.zeros((3, count))
    outliers = 0
    correlated = with_correlations(windows, problem.correlated)
    floors = problem.priors.floor[: windows[0].effects.shape[1]] if windows else np.empty(0)
    mended = without_outliers(correlated, grams_of(correlated, floors, count))
    for plain, window in zip(correlated, mended):
        innovation, expected, horizon = predict(window, noise, window.residual)
        weight = (plain.sigma / window.sigma) ** 2
        outliers += (weight < 1.0).sum()
        squares = np.array([innovation**2, expected, window.sigma**-2.0]) * window.sigma**2
        weighted = np.where(horizon >= 0, weight * squares, 0.0)
        added = np.array([np.bincount(window.channel, row, count) for row in weighted])
        added[1] = np.where(added[1] > FAR_ABOVE * added[0], added[0], added[1])
        sums += added
    return sums, outliers


def _blackbox(work: Work, cross: Crossed, rng: np.random.Generator) -> ndarray | None:
    """Return the squared errors of the black box on held-out groups, shape (F, C, H); None if it
    cannot be trained.
    """
    before = work.before
    table = table_of(before, rng)
    if table is None:
        return None
    trained = train(before, table, cross.groups)
    numbers = trained.statistics.flights
    weights = np.zeros((len(numbers), len(trained.reach)))
    for fold in cross.folds:
        training = np.setdiff1d(np.arange(len(weights)), fold)
        weights[fold] = trained.weights(training) if len(training) else 0.0
    residuals = []
    for window, size in zip(before.windows, weights[np.searchsorted(numbers, cross.groups)]):
        force = table.columns(window) @ size
        residuals.append(window.residual - window.latent @ force)
    channels = len(work.problem.model.channels)
    return errors(before.windows, cross.groups, work.after.noise, residuals, channels).square


def _nats(work: Work, cross: Crossed) -> float:
    """Return the increase of the held-out log-likelihood per sample; the models without and with
    effects have noise levels of their own.
    """
    plain = work.before.by_window.sum_by(cross.groups)
    named = work.after.by_window.sum_by(cross.groups)
    square = named.extrapolate(cross.trained).square
    return 0.5 * (plain.square.sum() - square.sum()) / named.samples.sum()
