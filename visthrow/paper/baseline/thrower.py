"""Throw with the baseline: sets of throws as units of work, for ``visthrow compare`` and
``visthrow report``.
"""

from collections.abc import Callable, Sequence
from dataclasses import replace
from functools import cache
from pathlib import Path
from typing import Any

import numpy as np

from sim.cores import cores
from visthrow.common import compute_device
from visthrow.paper.baseline import NAME
from visthrow.paper.baseline.fly_plan import delays_of, fly_pendulum, fly_plant
from visthrow.paper.baseline.pendulum_model import pendulum_of
from visthrow.paper.baseline.spline import PlanParams
from visthrow.paper.baseline.throw_plan import ThrowPlan, default_release, plan_throw
from visthrow.paper.results import PROTOCOL, Result, Unit, columns_of, join, key_of, work
from visthrow.task import Experiment, contract_of, load_experiment, plant_of
from visthrow.throws.reference_protocol import batches

IDEAL = (  # the controller's model, in addition to :data:`visthrow.throws.plants.PLANTS`
    "pendulum"
)

COMPENSATIONS = {
    "none": "no delays compensated",
    "delay": "all delays except the release's lag compensated",
    "both": "all delays compensated",
}
"""Compared compensation -> description; see :func:`visthrow.paper.baseline.fly_plan.delays_of`."""

BOUNDS = ("payload and thrust", "payload")
"""Bounded quantities of plans: ours, and only the payload, as in the paper."""

_experiment = cache(load_experiment)


def title_of(plant: str, compensation: str) -> str:
    """Return a row's name with plant and compensation."""
    return (
        "TO+MPC, own model (ideal)" if plant == IDEAL else f"TO+MPC, {COMPENSATIONS[compensation]}"
    )


def unit(
    plant: str,
    compensation: str,
    target: float,
    throws: int,
    seed: int = 0,
    *,
    height: float | None = None,
    speed: float | None = None,
    w_t: float | None = None,
    rho: float | None = None,
    bounds: str = BOUNDS[0],
    config_name: str = "state",
    overrides: Sequence[str] = (),
    batch: int = 0,
) -> Unit:
    """Return a unit of throws with the baseline at a target [m] along x.

    Args:
        plant: :data:`IDEAL`, or a name in :data:`visthrow.throws.plants.PLANTS`.
        compensation: name in :data:`COMPENSATIONS`; "none" in the controller's model.
        target: distance [m]. throws: number of throws. seed: seed of initial states and noise.
        height, speed: height [m] and speed [m/s] of the payload at release; default those of the
            learnt policy.
        w_t, rho: weights of duration and energy; default those of
            :class:`visthrow.paper.baseline.spline.PlanParams`.
        bounds: entry of :data:`BOUNDS`.
        config_name: train config whose plant is flown. overrides: changes of it.
        batch: index of the batch on a reference plant.
    """
    default_height, default_speed = default_release(target)
    params = PlanParams()
    return {
        "kind": NAME,
        "protocol": PROTOCOL,
        "plant": plant,
        "compensation": compensation,
        "target": float(target),
        "height": round(height or default_height, 6),
        "speed": round(speed or default_speed, 6),
        "w_t": float(w_t or params.duration),
        "rho": float(rho or params.energy),
        "bounds": bounds,
        "throws": int(throws),
        "seed": int(seed),
        "config": config_name,
        "overrides": list(overrides),
        "batch": int(batch),
        "conditions": key_of(contract_of(_experiment(config_name, tuple(overrides)))),
    }


def units(
    plant: str, compensation: str, target: float, throws: int, seed: int = 0, **how: Any
) -> list[Unit]:
    """Return the units of :func:`unit`, one for each batch of a reference plant."""
    if plant in (IDEAL, "hybrid"):
        return [unit(plant, compensation, target, throws, seed, **how)]
    return [
        unit(plant, compensation, target, size, seed, batch=i, **how) for i, size in batches(throws)
    ]


def plan_of(experiment: Experiment, unit: Unit) -> ThrowPlan:
    """Return the plan of a unit on an experiment's plant."""
    params = replace(PlanParams(), duration=unit["w_t"], energy=unit["rho"])
    if unit["bounds"] != BOUNDS[0]:  # the paper's plan, which a vehicle may not be able to follow
        params = replace(params, max_thrust=np.inf, least_lift=-np.inf, max_turn=np.inf)
    release = experiment.release
    return plan_throw(
        pendulum_of(plant_of(experiment)),
        unit["target"],
        unit["height"],
        unit["speed"],
        params,
        release.landing_height,
        experiment.sim.control_period,
        release.lag,
    )


def fly_unit(unit: Unit) -> tuple[dict[str, np.ndarray], dict[str, Any]]:
    """Plan and fly a unit; return columns of the throws, and the planned duration [s] and the
    computation times of the controller's steps [ms].
    """
    experiment = _experiment(unit["config"], tuple(unit["overrides"]))
    plan = plan_of(experiment, unit)
    count = unit["throws"]
    seed = unit["seed"]
    if unit["plant"] == IDEAL:
        flown = fly_pendulum(plan, count, seed)
    else:
        delays = delays_of(experiment, unit["compensation"])
        where = compute_device.resolve("auto") if unit["plant"] == "hybrid" else "cpu"
        flown = fly_plant(
            plan, unit["plant"], experiment, delays, count, seed, unit["batch"], where
        )
    columns = columns_of(flown)
    columns.pop("step_times", None)  # no column of throws, even if its length happens to match
    extra = {"planned": round(plan.duration, 6)}
    if len(flown.step_times):
        steps = 1e3 * np.percentile(flown.step_times, (50, 99))
        extra["step_ms"] = steps.round(3).tolist()
    return columns, extra


def rows(plants: Sequence[str]) -> list[tuple[str, str]]:
    """Return plant and compensation of a table's rows: the controller's model, and each plant with
    each compensation.
    """
    return [
        (IDEAL, "none"),
        *((plant, compensation) for plant in plants for compensation in COMPENSATIONS),
    ]


def fly_units(
    sets: Sequence[list[Unit]], folder: str | Path, say: Callable[[str], None]
) -> list[Result]:
    """Return the results of sets of units, with the batches of each set joined. Results in the
    folder are reused.
    """
    solutions = work(
        [u for part in sets for u in part],
        folder,
        fly_unit,
        None,
        cores(),
        lambda text: say(f"TO+MPC: {text}"),
    )
    return [join(solutions[key_of(u)] for u in part)[0] for part in sets]
