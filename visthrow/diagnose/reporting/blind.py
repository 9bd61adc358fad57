"""Effects hidden in the user's own noise: which sizes would have been named in these flights.

The worlds are drawn from the statistics: scores of the flights' own residuals with random signs a
flight, every effect somewhere within its floor, plus the score of the hidden effect.
:class:`Hidden` hides an effect in the measurements themselves, for a full search with the
simulation."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace

import numpy as np

from visthrow.diagnose.likelihood.evidence import STRONG, additions
from visthrow.diagnose.models.model_interface import Linearised, Model, Window
from visthrow.diagnose.select.result import Diagnosis

SIZES = np.geomspace(1.0, 64.0, 13)  # hidden sizes [floors]

DRAWS = 200
FEWEST_FLIGHTS = (
    6  # fewer give too few patterns of signs; noise is then drawn from its fitted level
)
NAMED = 0.9


@dataclass(frozen=True)
class Completeness:
    """The share of trials in which one effect is named, by its size."""

    name: str
    unit: str
    sizes: tuple[float, ...]  # [unit]
    exact: tuple[float, ...]  # share named, alone
    up_to_class: tuple[float, ...]  # share named or within 3 nats of what was named
    wrong: tuple[float, ...]  # share in which something else was named
    # size named, up to class, with probability 0.9 [unit]; NaN where none within its bounds is
    limit: float


@dataclass(frozen=True)
class Blind:
    """Detection limits in one set of flights."""

    curves: tuple[Completeness, ...]
    false_alarms: float  # share of worlds without a hidden effect in which something was named
    worlds: int
    noise: str  # where the noise came from

    def __getitem__(self, name: str) -> Completeness:
        return next(c for c in self.curves if c.name == name)


def hide(diagnosis: Diagnosis, *, seed: int = 0, draws: int = DRAWS) -> Blind:
    """Hide each effect at rising sizes in the flights' own noise and see whether the statistics
    name it.

    ``diagnosis``: of :func:`visthrow.diagnose.select.search.explain`; what it named is taken out
    first; ``draws``: worlds for each effect, size and sign."""
    work, rng = diagnosis.work, np.random.default_rng(seed)
    point, priors, effects = work.after, work.problem.priors, work.problem.model.effects
    information, score_of = point.information, point.statistics.score
    parametric = len(score_of) < FEWEST_FLIGHTS
    values, vectors = np.linalg.eigh(information)
    root = vectors * np.sqrt(np.maximum(values, 0.0))

    def worlds() -> np.ndarray:
        small = rng.uniform(-1.0, 1.0, (draws, len(effects))) @ information
        if parametric:
            return small + rng.standard_normal((draws, len(effects))) @ root.T
        return small + rng.choice((-1.0, 1.0), (draws, len(score_of))) @ score_of

    def named(score: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        gain = additions(information, score, priors, ())
        return gain, gain.max(axis=1) > diagnosis.threshold

    curves = []
    for j, effect in enumerate(effects):
        rows = []
        for size in SIZES:
            signs = [s for s in (-1.0, 1.0) if priors.low[j] <= s * size <= priors.high[j]]
            if not signs or not priors.visible[j]:
                break
            score = np.vstack([worlds() + s * size * information[j] for s in signs])
            gain, named_effect = named(score)
            best = gain.argmax(axis=1) == j
            close = gain[:, j] > gain.max(axis=1) - STRONG
            rows.append(
                (
                    size,
                    np.mean(named_effect & best),
                    np.mean(named_effect & close),
                    np.mean(named_effect & ~close),
                )
            )
        size, exact, similar, wrong = np.array(rows, dtype=float).reshape(-1, 4).T
        limit = _limit(size, similar) * effect.floor if rows else float("nan")
        curves.append(
            Completeness(
                effect.name,
                effect.unit,
                *map(tuple, (size * effect.floor, exact, similar, wrong)),
                limit,
            )
        )
    _, alarms = named(np.vstack([worlds() for _ in range(10)]))
    source = (
        "drawn from its fitted level"
        if parametric
        else "the flights' own residuals, with random signs a flight"
    )
    return Blind(tuple(curves), float(alarms.mean()), 10 * draws, source)


def _limit(size: np.ndarray, share: np.ndarray) -> float:
    """Size from which on the share stays at or above NAMED, interpolated in the logarithm of the
    size.
    """
    below = np.flatnonzero(share < NAMED)
    if not len(below):
        return float(size[0])
    last = below[-1]
    if last == len(size) - 1:
        return float("nan")
    part = (NAMED - share[last]) / (share[last + 1] - share[last])
    return float(np.exp(np.log(size[last]) + part * np.log(size[last + 1] / size[last])))


class Hidden:
    """A model whose flights hold one more effect: their measurements are shifted by what the
    simulation says it does.
    """

    def __init__(self, model: Model, truth: Mapping[str, float]) -> None:
        """Simulate twice and keep the difference; ``truth``: hidden sizes, in the
        effects' units.
        """
        self.model, self.effects, self.channels = model, model.effects, model.channels
        self._shift = [a - b for a, b in zip(model.residuals({}), model.residuals(truth))]

    def windows(self, theta: Mapping[str, float]) -> list[Window]:
        """See :class:`visthrow.diagnose.models.model_interface.Model`."""
        return [
            replace(w, residual=w.residual + s)
            for w, s in zip(self.model.windows(theta), self._shift)
        ]

    def residuals(
        self, theta: Mapping[str, float], linearised: Linearised | None = None
    ) -> list[np.ndarray]:
        """See :class:`visthrow.diagnose.models.model_interface.Model`."""
        return [r + s for r, s in zip(self.model.residuals(theta, linearised), self._shift)]


@dataclass(frozen=True)
class Trial:
    """One effect hidden in the measurements and searched for with the simulation."""

    name: str
    size: float  # hidden [unit]
    unit: str
    expected: float  # what was found of it before, plus what was hidden [unit]
    estimate: float  # [unit]; 0 where it was not named
    verdict: str
    named: tuple[str, ...]


def verify(
    diagnosis: Diagnosis,
    count: int,
    *,
    floors: float = 10.0,
    seed: int = 0,
    only: Sequence[str] = (),
) -> list[Trial]:
    """Hide effects in the measurements and run the whole search on each.

    ``floors``: size of what is hidden; ``only``: names to choose among; empty for all that can be
    seen."""
    from visthrow.diagnose.select.search import explain

    rng, problem = np.random.default_rng(seed), diagnosis.work.problem
    able = [
        e
        for e, v in zip(problem.model.effects, problem.priors.visible)
        if v and (not only or e.name in only)
    ]
    trials = []
    for effect in (able[i] for i in rng.permutation(len(able))[:count]):
        signs = [
            s
            for s in (-1.0, 1.0)
            if effect.bounds[0] <= s * floors * effect.floor <= effect.bounds[1]
        ]
        if not signs:
            continue
        size = float(rng.choice(signs)) * floors * effect.floor
        verdicts = explain(
            Hidden(problem.model, {effect.name: size}),
            seed=seed,
            without=diagnosis.events,
            laws=False,
        )
        finding = verdicts[effect.name]
        expected = diagnosis.theta.get(effect.name, 0.0) + size
        trials.append(
            Trial(
                effect.name,
                size,
                effect.unit,
                expected,
                finding.estimate,
                finding.verdict,
                verdicts.named,
            )
        )
    return trials
