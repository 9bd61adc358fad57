"""Latent forces by block and phase: the unexplained forces, and whether they are excessive.

Gusts and draughts do not depend on what the vehicle does. A latent force that is several times
stronger in throws than in the quietest phase is therefore an error of the model."""

from collections import Counter, defaultdict
from dataclasses import replace
from functools import partial

import numpy as np
from numpy import ndarray

from visthrow.diagnose.likelihood.evidence import NORMAL_95, UNKNOWN_RATIO
from visthrow.diagnose.likelihood.forms import unit_of
from visthrow.diagnose.likelihood.integrals import fit_windows
from visthrow.diagnose.likelihood.marginal import Gram
from visthrow.diagnose.likelihood.threads import parallel_map
from visthrow.diagnose.models.model_interface import LATENT_BLOCKS, Indices, Window
from visthrow.diagnose.select.point import Point
from visthrow.diagnose.select.result import Level

LANDING = 5e-3
"""Smallest displacement of a body within a window [m] for which a latent force matters. The floors
of effects correspond to the same error of a landing.
"""

STEP = 1.4  # factor between the levels that are tried for an upper limit
MOST_STEPS = 60  # largest number of them, where nothing limits the level


def levels(before: Point, after: Point, threshold: float) -> tuple[Level, ...]:
    """Compare the latent forces of each block and phase with the block's quietest phase, and with
    the force that would move a landing.

    ``threshold``: evidence for an excessive level, if there were only one [nats]; it grows with
    their number."""
    noise = after.noise
    threshold = threshold + np.log(max(len(noise.latent_sd), 1))
    limits = {key: _upper_limit(after, key) for key in noise.latent_sd}
    floors = floors_of(after)
    listed = []
    for key in sorted(limits, key=lambda key: key[0]):
        block, phase = key
        level = noise.latent_sd[key]
        quiet = min(limit for (b, _), limit in limits.items() if b == block)
        most = max(UNKNOWN_RATIO * quiet, floors.get(key, 0.0))
        nats = 0.0
        if level > most:
            nats = _likelihood(after, key, level) - _likelihood(after, key, most)
        earlier = before.noise.latent_sd.get(key, float("nan"))
        name = LATENT_BLOCKS[block]
        excessive = bool(nats > threshold)
        listed.append(Level(name, phase, earlier, level, quiet, nats, excessive))
    return tuple(listed)


def compares_phases(point: Point) -> bool:
    """Return whether a calm phase shows how strong gusts are; otherwise residuals are compared with
    the sensors' noise.
    """
    phases = Counter(block for block, _ in point.noise.latent_sd)
    return max(phases.values(), default=0) > 1


def floors_of(point: Point) -> dict[tuple[int, str], float]:
    """Return the latent deviation [N or N m] of each block and phase that moves a position by
    ``LANDING`` in the median window.
    """
    moves = defaultdict(list)
    reaches = parallel_map(partial(_reaches, positions_of(point)), point.grams, point.windows)
    for gram, reach in zip(point.grams, reaches):
        for block, distance in reach.items():
            moves[block, gram.phase].append(distance)
    medians = {key: np.median(distances) for key, distances in moves.items()}
    return {key: LANDING / median for key, median in medians.items() if median > 0.0}


def _reaches(positions: Indices, gram: Gram, window: Window) -> dict[int, float]:
    """Return how far unit latents of each block move a position within a window [m]; empty if no
    position was measured.
    """
    rows = np.isin(window.channel, positions)
    if not rows.any():
        return {}
    square = (window.latent[rows] @ gram.factor) ** 2
    reaches = {}
    for block in np.unique(gram.latent_block):
        of_block = square @ (gram.latent_block == block)
        reaches[block] = np.sqrt(of_block.max())
    return reaches


def positions_of(point: Point) -> list[int]:
    """Return the indices of the channels that are positions."""
    channels = point.problem.model.channels
    return [c for c, name in enumerate(channels) if unit_of(name) == "m"]


def _likelihood(point: Point, key: tuple[int, str], level: float) -> float:
    """Return the log-likelihood of a phase's residuals for a level of a block and phase."""
    windows = [w for w, gram in enumerate(point.grams) if gram.phase == key[1]]
    noise = point.noise
    latent_sd = {**noise.latent_sd, key: level}
    tried = replace(noise, latent_sd=latent_sd, share=noise.share[windows])
    return fit_windows([point.grams[w] for w in windows], tried)[1].sum()


def _upper_limit(point: Point, key: tuple[int, str]) -> float:
    """Return the largest level of a block that a phase's residuals allow, one-sided 97.5 %."""
    best = point.noise.latent_sd[key]
    of_phase = [gram.phase == key[1] for gram in point.grams]
    least = -0.5 * (point.by_window.square[of_phase].sum() + NORMAL_95**2)
    for step in range(1, MOST_STEPS):
        if _likelihood(point, key, best * STEP**step) < least:
            break
    return best * STEP**step


def acts_on(point: Point, effects: Indices, *, free_effects: Indices = ()) -> list[str]:
    """Return the block on which each of some effects acts, "" if it only changes measurements.

    An effect's column is regressed on the columns of each block's latent forces. It acts on the
    block that explains most of it, if that is at least half. ``point``: with the latent forces'
    derivatives; ``free_effects``: effects of any size, which are regressed out first."""
    weight = point.noise.scale**-2.0
    total = np.zeros(len(effects))
    by_block = {name: np.zeros(len(effects)) for name in LATENT_BLOCKS}
    for gram in point.grams:
        inner = np.tensordot(weight, gram.inner, 1)
        free = [*range(gram.nuisances), *(gram.hidden + k for k in free_effects)]
        columns = gram.hidden + np.asarray(effects, dtype=int)
        known = _explained_squares(inner, free, columns)
        total += inner[columns, columns] - known
        for block in np.unique(gram.latent_block):
            latents = gram.nuisances + np.flatnonzero(gram.latent_block == block)
            explained = _explained_squares(inner, [*free, *latents], columns)
            by_block[LATENT_BLOCKS[block]] += explained - known
    blocks = []
    for i, whole in enumerate(total):
        parts = {name: explained[i] for name, explained in by_block.items()}
        best = max(parts, key=parts.get)
        blocks.append(best if parts[best] > 0.5 * whole > 0.0 else "")
    return blocks


def _explained_squares(inner: ndarray, basis: Indices, columns: ndarray) -> ndarray:
    """Return the part of each column's sum of squares that other columns explain.

    ``inner``: inner products of all columns, shape (P, P); ``basis``: indices of the others.
    """
    normal = inner[np.ix_(basis, basis)]
    right = inner[np.ix_(basis, columns)]
    normal += np.diag(1e-9 * np.diag(normal) + 1e-12)
    return (right * np.linalg.solve(normal, right)).sum(0)


def too_strong(point: Point, share: float) -> tuple[str, ...]:
    """Return the phases in which the latent force on the vehicle exceeds a share of the thrust that
    carries it.
    """
    thrusts = defaultdict(list)
    for window in point.windows:
        thrust = window.knots.get("thrust", ())
        if len(thrust):
            thrusts[window.phase].append(np.median(np.abs(thrust)))
    medians = [np.median(of_phase) for of_phase in thrusts.values()]
    weight = max(medians, default=np.inf)
    block = LATENT_BLOCKS.index("vehicle force")
    levels = point.noise.latent_sd.items()
    return tuple(phase for (b, phase), level in levels if b == block and level > share * weight)
