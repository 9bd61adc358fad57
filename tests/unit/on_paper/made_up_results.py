"""Synthetic results with known means, for tests of the report."""

import numpy as np

from visthrow.paper import results
from visthrow.paper.report.result_set import SHIPPED, ResultSet
from visthrow.paper.results import Result
from visthrow.task.measurement import TARGETS

MADE = {
    "commit": "0" * 40,
    "command": "made up",
    "time": "2020-01-01T00:00:00+00:00",
    "seconds": 1.0,
}
PLANTS = ("hybrid", "reference", "reference-realistic")


def columns(
    rng,
    target: float,
    count: int,
    spread: float,
    offset=(0.0, 0.0),
    duration: float = 1.05,
    lost: int = 0,
) -> dict:
    """Normal misses of a standard deviation about an offset."""
    miss = rng.normal(offset, spread, (count, 2))
    success = np.arange(count) >= lost
    blank = np.where(success, 1.0, np.nan)
    return {
        "success": success,
        "landing_w": (miss + [target, 0.0]) * blank[:, None],
        "error": np.linalg.norm(miss, axis=1) * blank,
        "duration": (duration + 0.01 * rng.normal(size=count)) * blank,
        "clearance": 0.4 * blank,
        "smoothness": 0.2 * blank,
    }


def policy(
    rng,
    name: str,
    layout: str,
    plant: str,
    target: float,
    spread: float = 0.02,
    offset=(0.0, 0.0),
    **how,
) -> Result:
    """Throws of a policy that does not exist."""
    count, duration = how.pop("count", 60), how.pop("duration", 1.05)
    unit = results.policy_unit(name, "0" * 16, layout, plant, target, count, **how)
    return Result(unit, columns(rng, target, count, spread, offset, duration), MADE)


def make_shipped_book() -> ResultSet:
    """A book with throws of the shipped policies, and with unrelated entries."""
    rng = np.random.default_rng(0)
    thrown = [
        policy(rng, name, name.partition("_")[0], plant, target, 0.02 if name == "state" else 0.024)
        for name in SHIPPED
        for plant in PLANTS
        for target in TARGETS
    ]
    return ResultSet(tuple(thrown), (), {"throws": "Because **this** was so.\n\nAnd `that`."})
