"""What named causes do to predicted landings, on throws that were held out where there are enough."""

from collections.abc import Mapping
from dataclasses import dataclass

import numpy as np

from visthrow.common.statistics import mean
from visthrow.diagnose.select.state import Work
from visthrow.diagnose.throw.landing import Landings


@dataclass(frozen=True)
class LandingGain:
    """What the named causes do to predicted landings; lengths in metres, intervals of 95 % by bootstrap over throws."""

    throws: int
    held_out: bool  # whether each throw was predicted with causes sized by the other flights
    before: float  # mean distance of prediction and measurement, open loop from before the throw, the model as it stands
    after: float  # with what was named
    low: float  # of ``after``
    high: float
    released_before: float  # the same from a state fitted up to the separation
    released_after: float
    moved: dict[str, float]  # named effect -> mean distance by which it moves the predicted landings
    off_before: tuple[tuple[float, float], ...] = ()  # of each throw, prediction less measurement along world x and y
    off_after: tuple[tuple[float, float], ...] = ()


def landing_gain(
    work: Work, theta: Mapping[str, float], trained: Mapping[int, Mapping[str, float]], seed: int
) -> LandingGain | None:
    """What the named causes do to predicted landings.

    ``trained``: flight -> their sizes by the other flights; empty where none were held out.

    Returns:
        None where the model has no throws whose landing was seen.
    """
    model = work.problem.model
    if not hasattr(model, "landings"):
        return None
    flown = sorted({w.flight for w in work.after.windows})
    plain = model.landings({}, flown)
    named = model.landings(theta, flown) if theta else plain
    parts = [model.landings(trained[int(f)], [int(f)]) for f in plain.flights] if trained else [named]
    held = Landings(*(np.concatenate(column) for column in zip(*(vars(part).values() for part in parts))))
    good = np.isfinite(plain.errors) & np.isfinite(held.errors)
    if not good.any():
        return None
    moved = {}
    for name in theta:
        others = {other: size for other, size in theta.items() if other != name}
        without = model.landings(others, flown) if others else plain
        moved[name] = float(np.nanmean(np.linalg.norm((named.predicted - without.predicted)[good, :2], axis=1)))
    after = mean(held.errors[good], seed=seed)
    released = [float(np.nanmean(found.released_errors[good])) for found in (plain, held)]
    off = [tuple(map(tuple, (x.predicted - x.measured)[good, :2].tolist())) for x in (plain, held)]
    return LandingGain(
        int(good.sum()), bool(trained), float(plain.errors[good].mean()), after.value, after.low, after.high, *released, moved, *off
    )
