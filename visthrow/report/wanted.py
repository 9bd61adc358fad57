"""Which throws of the baseline the report stands on. Those of policies stand in the lists of ``configs/sweep``."""

from collections.abc import Iterator
from typing import Any

from visthrow.baseline import front, thrower
from visthrow.tables import PAPER

TARGETS = tuple(sorted({target for _, target in PAPER}))
"""Of the paper's tables [m]."""

FRONT_TARGET = 2.0
"""Of the sweep (the paper, Table IV) [m]."""

BOUNDS = ("payload and thrust", "payload")
"""What plans bound: ours, and the payload alone as the paper's do."""

POLICY_LISTS = ("paper", "gap")
"""Lists of ``configs/sweep`` that the full report reads; QUICK_LIST that of ``--quick``."""

QUICK_LIST = "quick"


def full() -> list[dict[str, Any]]:
    """Units of the committed record ``baseline``: the cheap and telling ones first."""
    return [*_by_target(50, 20), *_front(10)]


def quick() -> list[dict[str, Any]]:
    """Few throws, for a look within minutes."""
    flown = [thrower.unit("hybrid", compensation, FRONT_TARGET, 10) for compensation in ("both", "delay")]
    return [*_own(TARGETS, 5), *flown]


def _own(targets: tuple[float, ...], throws: int) -> Iterator[dict[str, Any]]:
    for target in targets:
        yield from thrower.units(thrower.OWN, "none", target, throws)


def _by_target(throws: int, on_reference: int) -> Iterator[dict[str, Any]]:
    yield from _own(TARGETS, throws)
    for compensation in reversed(thrower.MADE_UP):
        for target in TARGETS:
            yield from thrower.units("hybrid", compensation, target, throws)
    for compensation in ("both", "delay"):
        for target in TARGETS:
            yield from thrower.units("reference-realistic", compensation, target, on_reference)


def _front(throws: int) -> Iterator[dict[str, Any]]:
    settings = [(speed, w_t, rho) for speed in front.SPEEDS for w_t, rho in front.WEIGHTS]

    def all_settings(plant: str, compensation: str, bounds: str, speeds=front.SPEEDS) -> Iterator[dict[str, Any]]:
        for speed, w_t, rho in settings:
            if speed in speeds:
                how = {"speed": speed, "w_t": w_t, "rho": rho, "bounds": bounds}
                yield from thrower.units(plant, compensation, FRONT_TARGET, throws, **how)

    for bounds in BOUNDS:
        yield from all_settings(thrower.OWN, "none", bounds)
        yield from all_settings("hybrid", "both", bounds)
    yield from all_settings("hybrid", "delay", BOUNDS[0])
    yield from all_settings("reference-realistic", "both", BOUNDS[0], speeds=front.SPEEDS[1::2])
    yield from all_settings("reference-realistic", "delay", BOUNDS[0], speeds=front.SPEEDS[1:2])
