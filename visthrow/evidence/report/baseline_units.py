"""Which throws of the baseline the report stands on. Those of policies stand in the lists of ``configs/sweep``."""

from collections.abc import Iterator
from typing import Any

from visthrow.baseline import front, thrower
from visthrow.view.tables import PAPER

TARGETS = tuple(sorted({target for _, target in PAPER}))
"""Targets of the paper's tables [m]."""

FRONT_TARGET = 2.0
"""Target of the sweep (the paper, Table IV) [m]."""

FRONT_THROWS = 10
"""A setting of the sweep, as in the paper."""

BOUNDS = ("payload and thrust", "payload")
"""What plans bound: ours, and the payload alone as the paper's do."""

QUICK_LIST = "quick"
"""List of ``configs/sweep`` for ``--quick``; the full report reads what the lists ``paper`` and ``gap`` made."""


def full() -> list[dict[str, Any]]:
    """Units of the committed record ``baseline``: the cheap and informative ones first."""
    made_up = [*_front(), *_on_reference("both", 20, front.SPEEDS[1::2])]
    return [*_by_target(50), *made_up, *_late_front(), *_on_reference("delay", 20, front.SPEEDS[1:2])]


def quick() -> list[dict[str, Any]]:
    """Few throws, for a look within minutes."""
    flown = [thrower.unit("hybrid", compensation, FRONT_TARGET, 10) for compensation in ("both", "delay")]
    return [*_own(TARGETS, 5), *flown]


def _own(targets: tuple[float, ...], throws: int) -> Iterator[dict[str, Any]]:
    for target in targets:
        yield from thrower.units(thrower.OWN, "none", target, throws)


def _by_target(throws: int) -> Iterator[dict[str, Any]]:
    yield from _own(TARGETS, throws)
    for compensation in reversed(thrower.MADE_UP):
        for target in TARGETS:
            yield from thrower.units("hybrid", compensation, target, throws)


def _settings(speeds: tuple[float, ...] = front.SPEEDS) -> Iterator[dict[str, float]]:
    for speed in speeds:
        for w_t, rho in front.WEIGHTS:
            yield {"speed": speed, "w_t": w_t, "rho": rho}


def _front() -> Iterator[dict[str, Any]]:
    """The sweep in the own model and, all delays made up for, in the training simulator."""
    for bounds in BOUNDS[::-1]:
        for how in _settings():
            yield from thrower.units(thrower.OWN, "none", FRONT_TARGET, FRONT_THROWS, bounds=bounds, **how)
            yield from thrower.units("hybrid", "both", FRONT_TARGET, FRONT_THROWS, bounds=bounds, **how)


def _late_front() -> Iterator[dict[str, Any]]:
    """The sweep where the release's lag is not made up for."""
    for how in _settings():
        yield from thrower.units("hybrid", "delay", FRONT_TARGET, FRONT_THROWS, **how)


def _on_reference(compensation: str, throws: int, speeds: tuple[float, ...]) -> Iterator[dict[str, Any]]:
    """By target and a part of the sweep: a throw takes seconds there."""
    for target in (FRONT_TARGET, *(target for target in TARGETS if target != FRONT_TARGET)):
        yield from thrower.units("reference-realistic", compensation, target, throws)
    for how in _settings(speeds):
        yield from thrower.units("reference-realistic", compensation, FRONT_TARGET, FRONT_THROWS, **how)
