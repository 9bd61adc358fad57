"""Likelihood that models lose against the true one on held-out flights."""

from collections.abc import Mapping, Sequence

import numpy as np

from visthrow.diagnose.likelihood import noise_levels as levels
from visthrow.diagnose.likelihood.evidence import Priors
from visthrow.diagnose.likelihood.integrals import Integrals
from visthrow.diagnose.likelihood.marginal import correlate_all, gram_of
from visthrow.diagnose.models.model_interface import Model


def shortfalls(model: Model, sizes: Sequence[Mapping[str, float]]) -> tuple[list[float], int]:
    """Nats by which each of some sizes explains held-out flights worse than the last one does.

    Initial states and gusts are integrated out (a forecast without gusts would mostly measure
    those); the levels of noise and gusts are those of the last sizes.

    Returns:
        Nats by which each likelihood falls short of the last one, and the number of samples.
    """
    channels = len(model.channels)
    priors = Priors.of(model.effects, model.channels)
    windows_by_size = [model.windows(theta) for theta in sizes]
    raw = [[gram_of(w, priors.floor, channels) for w in windows] for windows in windows_by_size]
    noise, _ = levels.fit(windows_by_size[-1], raw[-1])
    squares = []
    for windows, grams in zip(windows_by_size, raw):
        shaped = correlate_all(grams, windows, noise.correlation_time)
        statistics = Integrals(shaped, noise).statistics(shaped, np.zeros(len(priors.floor)))
        squares.append(statistics.square.sum())
    return [float(0.5 * (square - squares[-1])) for square in squares], sum(
        len(w.residual) for w in windows_by_size[-1]
    )
