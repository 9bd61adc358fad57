"""What flights say of thousands of terms of the grammar at once, without a simulation.

The column of a term is G A v: G are the derivatives by the latent forces, A the latent forces that anything exerted at the knots
stands for, v the term's values there. So a window needs A' G' V^-1 G A alone, with V as in :mod:`visthrow.diagnose.likelihood.marginal`,
and all terms are a product of tables.
"""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from functools import lru_cache

import numpy as np
import torch

from visthrow.diagnose.likelihood import grammar
from visthrow.diagnose.likelihood.evidence import Priors, covariance
from visthrow.diagnose.likelihood.marginal import WindowStatistics, gather
from visthrow.diagnose.likelihood.stack import BATCH, statistics
from visthrow.diagnose.likelihood.threads import each
from visthrow.diagnose.likelihood.transfer import all_to_host, side_by_side
from visthrow.diagnose.models.interface import LATENT_BLOCKS
from visthrow.diagnose.select.point import Point

ROUGHER = 2.0
"""While terms are screened, no phase is rougher than so many times the usual."""


@lru_cache(maxsize=32)
def _terms(block: str, known: tuple[str, ...]) -> tuple[grammar.Term, ...]:
    return tuple(grammar.terms(block, known))


@lru_cache(maxsize=32)
def _layout(block: str, known: tuple[str, ...]) -> grammar.Layout | None:
    terms = _terms(block, known)
    return grammar.Layout.of(terms) if terms else None


@dataclass
class Screen:
    """Information of all terms about one point, summed over windows."""

    terms: tuple[grammar.Term, ...]
    size: np.ndarray  # root mean square over the knots, shape (T,)
    own: np.ndarray  # shape (T,)
    score: np.ndarray
    cross: np.ndarray  # with the effects, shape (T, K)


def felt(block: str) -> str:
    """Latent block whose levels a term's size is measured in."""
    return "vehicle torque" if block == grammar.JOINT else block


def carries(latent_block: np.ndarray, block: str) -> bool:
    """Whether a window has all latents that terms of a block act through."""
    return set(map(LATENT_BLOCKS.index, grammar.acting(block))) <= set(np.unique(latent_block).tolist())


def usual(levels: Mapping[tuple[int, str], float], block: int) -> float:
    """The lower median of a block's levels; the least of a phase with few windows may be anything."""
    own = sorted(level for (b, _), level in levels.items() if b == block)
    return own[(len(own) - 1) // 2]


def calmed(point: Point) -> tuple[Point, list[WindowStatistics]]:
    """The point as if no phase were much rougher than is usual in its block, and the statistics of its windows.

    A force that the model lacks is taken for gusts in the phases in which it acts; there no term of it would stand out.
    """
    levels = point.noise.latent_sd
    limits = {block: ROUGHER * usual(levels, block) for block in {block for block, _ in levels}}
    noise = replace(point.noise, latent_sd={key: min(level, limits[key[0]]) for key, level in levels.items()})
    parts = statistics(point.grams, noise, point.device)
    return replace(point, noise=noise, plain=gather(point.grams, parts, point.theta)), parts


def screen(point: Point, parts: Sequence[WindowStatistics], block: str, known: Sequence[grammar.Known]) -> Screen | None:
    """Gather what each term of a block says; None where the windows carry no knots for any.

    Args:
        point: that the terms are about.
        parts: statistics of its windows.
        block: of the terms.
        known: quantities at the knots of its windows.
    """
    through = [w for w, gram in enumerate(point.grams) if carries(gram.latent_block, block)]
    names = [set(point.windows[w].knots) for w in through]
    shared = tuple(sorted(set.intersection(*names))) if names else ()
    layout = _layout(block, shared) if "time" in shared else None
    if layout is None:
        return None
    own, size = LATENT_BLOCKS.index(felt(block)), BATCH if point.device == "cpu" else len(through)

    ends = np.cumsum([len(known[w]["time"]) for w in through])[:-1]
    factors = zip(*(np.split(values, ends) for values in layout.factors(grammar.joined([known[w] for w in through], shared))))
    exerted = each(lambda w: _exerted(point, parts[w], w, block, known[w], own), through)
    told = [(*one, *at_knots) for one, at_knots in zip(exerted, factors)]
    batches = [told[first : first + size] for first in range(0, len(told), size)]
    shares = each(lambda batch: _products(batch, layout, point.device), batches)
    square, information, score, cross = map(sum, zip(*shares))
    rows = sum(int((point.grams[w].latent_block == own).sum()) // 3 for w in through)
    return Screen(_terms(block, shared), np.sqrt(square / max(rows, 1)), information, score, cross)


def _exerted(point: Point, part: WindowStatistics, w: int, block: str, known: grammar.Known, own: int) -> tuple[np.ndarray, ...]:
    """Of what is exerted at a window's knots: square and information, score and cross information."""
    through = grammar.through_latents(point.windows[w], known, block)
    here = through[point.grams[w].latent_block == own]
    score = part.latent_score + part.latent_effects @ point.theta
    return here.T @ here, through.T @ part.latent_information @ through, through.T @ score, through.T @ part.latent_effects


def _products(windows: Sequence[tuple[np.ndarray, ...]], layout: grammar.Layout, device: str) -> tuple[np.ndarray, ...]:
    """Square, information, score and cross information of all terms, of these windows together.

    Args:
        windows: of each, what is exerted at its knots, and the scalars and vectors there.
        layout: of the terms.
        device: where to calculate.
    """
    longest = max((len(scalars) for *_, scalars, _ in windows), default=0)
    square, information, score, cross, scalars, vectors = (
        _padded(arrays, axes, longest, device)
        for arrays, axes in zip(zip(*windows), ((3, 3), (3, 3), (3,), (3, None), (1, None), (1, None, None)))
    )
    values = vectors[..., torch.from_numpy(layout.vector).to(device)]
    for which in layout.scalar:
        values *= scalars[:, :, None, torch.from_numpy(which).to(device)]
    values = values.reshape(len(windows), 3 * longest, -1)
    flat, cross = values.reshape(-1, values.shape[-1]), cross.reshape(-1, cross.shape[-1])
    squares = [((inner @ values) * values).sum((0, 1)) for inner in (square, information)]
    return tuple(all_to_host((*squares, score.reshape(-1) @ flat, flat.T @ cross)))


def _padded(arrays: Sequence[np.ndarray], axes: Sequence[int | None], longest: int, device: str) -> torch.Tensor:
    """Arrays side by side, with zeros up to so many knots along each axis that has some entries a knot."""
    shape = tuple(size if per is None else per * longest for size, per in zip(arrays[0].shape, axes))
    return side_by_side([[array] for array in arrays], shape, device)


def gains(point: Point, priors: Priors, active: Sequence[int], of: Screen, reach: float) -> tuple[np.ndarray, np.ndarray]:
    """Nats of each term beside a set of names, and its prior deviation, which makes it ``reach`` strong at the knots."""
    sigma = covariance(point.information, priors.deviation(list(active)))
    own = np.maximum(of.own - np.einsum("tk,kl,tl->t", of.cross, sigma, of.cross, optimize=True), 0.0)
    score = of.score - of.cross @ (sigma @ point.score)
    prior = reach / np.maximum(of.size, 1e-12 * of.size.max() + 1e-300)
    gain = -0.5 * np.log1p(prior**2 * own) + 0.5 * score**2 / (own + prior**-2.0)
    gain[of.size <= 1e-9 * of.size.max()] = -np.inf
    return gain, prior


def distinct(gain: np.ndarray, of: Screen, most: int) -> list[int]:
    """The best terms, without those that are a simpler one in other words in these flights."""
    kept: list[int] = []
    unit = of.score / np.maximum(of.size, 1e-300)
    for i in np.argsort(-gain, kind="stable")[: 8 * most]:
        if len(kept) == most or not np.isfinite(gain[i]):
            break
        if not any(np.isclose(abs(unit[i]), abs(unit[k]), rtol=1e-3) for k in kept):
            kept.append(int(i))
    return kept
