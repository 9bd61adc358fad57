"""Results that nobody flew, for tests of the report: every kind of set of throws, with
known means.
"""

import numpy as np

from visthrow.paper.baseline import front, thrower
from visthrow.paper.report.ablations import FURTHER, PAPER_FOUR
from visthrow.paper.report.gap import SWEEPS, TRAINED
from visthrow.paper.report.result_set import SHIPPED, ResultSet
from visthrow.task.measurement import TARGETS
from visthrow.throws import results
from visthrow.throws.results import Result

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
    """Throws of a policy that is not there."""
    count, duration = how.pop("count", 60), how.pop("duration", 1.05)
    unit = results.policy_unit(name, "0" * 16, layout, plant, target, count, **how)
    return Result(unit, columns(rng, target, count, spread, offset, duration), MADE)


def baseline(
    rng,
    plant: str,
    compensation: str,
    target: float,
    error: float,
    duration: float,
    lost: int = 0,
    **how,
) -> Result:
    """Throws of the baseline; their error follows the velocity error."""
    (unit,) = thrower.units(plant, compensation, target, 10, **how)
    made = columns(rng, target, 10, error, duration=duration, lost=lost)
    made["velocity_error"] = 0.4 * made["error"]
    made |= dict.fromkeys(("position_error", "tracking"), 0.02 + 0.0 * made["error"])
    return Result(unit, made, MADE, {"planned": duration})


def _ablations(rng):
    for plant in PLANTS[1:]:
        for layout in SHIPPED:
            for seed in (1, 2, 3):
                yield policy(rng, f"{layout}-{seed}", layout, plant, 2.0, train_seed=seed)
            for i, variant in enumerate((*PAPER_FOUR, *FURTHER)):
                for seed in (1, 2, 3) if i < 4 and layout == "state" else (1,):
                    yield policy(
                        rng,
                        f"{layout}_{variant}-{seed}",
                        layout,
                        plant,
                        2.0,
                        0.02,
                        (-0.02 * i, 0.0),
                        run=f"{layout}_{variant}",
                        variant=variant,
                        train_seed=seed,
                        departures={"vehicle.changed": variant},
                    )


def _baselines(rng):
    for target in TARGETS:
        yield baseline(rng, thrower.IDEAL, "none", target, 0.002, 1.6)
        for compensation, lost in (("none", 10), ("delay", 0), ("both", 0)):
            yield baseline(rng, "hybrid", compensation, target, 0.05, 1.6, lost)
    for i, speed in enumerate(front.SPEEDS):
        for j, (w_t, rho) in enumerate(front.WEIGHTS):
            how = {"speed": speed, "w_t": w_t, "rho": rho}
            for bounds, faster in zip(thrower.BOUNDS, (0.0, 0.4)):
                fast = 1.3 + 0.1 * i + 0.2 * j - faster
                yield baseline(
                    rng, thrower.IDEAL, "none", 2.0, 0.03 / fast**3, fast, bounds=bounds, **how
                )
                yield baseline(
                    rng,
                    "hybrid",
                    "both",
                    2.0,
                    0.2 / fast**3,
                    fast,
                    lost=5 if faster else 0,
                    bounds=bounds,
                    **how,
                )


def _gap(rng):
    for sweep in SWEEPS:
        for name in sweep.policies:
            for k in range(5):
                value = (
                    [0.005 * k, 0.005 * k]
                    if sweep.key == "task.observation.latency"
                    else round(0.02 * (k + 1), 4)
                )
                yield policy(
                    rng,
                    name,
                    name.partition("_")[0],
                    "hybrid",
                    2.0,
                    0.02 * (1 + 0.3 * k),
                    departures={sweep.key: value},
                )
    for plant in PLANTS[::2]:
        for variant in TRAINED:
            if variant != "full":
                yield policy(
                    rng,
                    f"vision_{variant}-1",
                    "vision",
                    plant,
                    2.0,
                    0.03,
                    variant=variant,
                    train_seed=1,
                )
        for seed in (1, 2, 3):
            yield policy(rng, f"vision-{seed}", "vision", plant, 2.0, train_seed=seed)


def _beyond(rng):
    for layout in SHIPPED:
        for speed in (0.0, 0.25, 0.5, 0.75, 1.0):
            departures = {"task.target.speed": [speed, speed]}
            yield policy(
                rng,
                f"{layout}_moving-1",
                layout,
                "hybrid",
                2.0,
                0.03 + 0.05 * speed,
                variant="moving",
                departures=departures,
            )
        yield policy(
            rng, layout, layout, "hybrid", 2.0, 0.3, departures={"task.target.speed": [0.5, 0.5]}
        )
        yield policy(
            rng, f"{layout}_payload-1", layout, "hybrid", 2.0, 0.04, variant="payload", train_seed=1
        )
        yield policy(
            rng, layout, layout, "hybrid", 2.0, 0.09, departures={"task.start.payload_spread": 0.2}
        )
        yield policy(
            rng, f"{layout}_far-1", layout, "hybrid", 3.0, 0.05, variant="far", train_seed=1
        )


def runs() -> tuple[dict, ...]:
    """Training runs with learning curves."""
    curve = [[2e6 * k, 0.9 * k, 0.5 / (1 + k)] for k in range(1, 60)]
    base = {
        "layout": "state",
        "steps": 2e8,
        "iterations": 600,
        "environments": 16384,
        "seconds": 80.0,
        "wall_s": 90.0,
        "pieces": 1,
        "device": "H200",
        "commit": "0" * 40,
        "final": {"error_mean": 0.025, "duration_mean": 1.05},
        "curve": curve,
    }
    names = ("state", "vision", *(f"state_{v}" for v in PAPER_FOUR))
    return tuple(
        {"name": f"{n}-{s}", "run": n, "variant": "full", "train_seed": s, **base}
        for n in names
        for s in (1, 2)
    )


def everything(seed: int = 0) -> ResultSet:
    """A book with a result for every question of the report."""
    rng = np.random.default_rng(seed)
    names = SHIPPED
    shipped = [
        policy(rng, name, name.partition("_")[0], plant, target, 0.02 if name == "state" else 0.024)
        for name in names
        for plant in PLANTS
        for target in TARGETS
    ]
    made = [*shipped, *_ablations(rng), *_baselines(rng), *_gap(rng), *_beyond(rng)]
    return ResultSet(
        tuple({r.key: r for r in made}.values()),
        runs(),
        {"ablations": "Because **this** was so.\n\nAnd `that`."},
    )
