"""Which throws of the baseline the report stands on. Those of policies stand in the lists of ``configs/sweep``."""

from typing import Any

from visthrow.baseline import thrower
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


def quick() -> list[dict[str, Any]]:
    """Few throws, for a look within minutes."""
    own = [unit for target in TARGETS for unit in thrower.units(thrower.OWN, "none", target, 5)]
    return own + [thrower.unit("hybrid", compensation, FRONT_TARGET, 10) for compensation in ("both", "delay")]
