"""Tables by target and by plant, the sweep that trades agility for accuracy, and the figures that sum it up.

Every row is a dictionary: ``plant`` ("pendulum" for the controller's own model, or a plant of :mod:`visthrow.throws.plants`),
``compensation``, ``target``, ``speed``, ``height``, ``w_t``, ``rho``, ``planned`` (duration) and
:meth:`visthrow.baseline.fly.Flown.summary`.
"""

from collections.abc import Callable, Sequence
from dataclasses import dataclass, field, replace

import numpy as np

from visthrow.baseline.fly import COMPENSATIONS as COMPENSATIONS
from visthrow.baseline.fly import Flown, delays_of, fly_pendulum, fly_plant
from visthrow.baseline.pendulum import Pendulum, pendulum_of
from visthrow.baseline.plan import Plan, plan_throw
from visthrow.baseline.release import default_release
from visthrow.baseline.spline import PlanParams
from visthrow.common.statistics import pareto
from visthrow.task import Experiment, plant_of
from visthrow.view.tables import PAPER

SPEEDS = (1.7, 2.2, 2.5, 2.9)
"""Release speeds of the sweep [m/s]; the paper's are 1.7 and 2.2."""

WEIGHTS = ((1e6, 0.005), (200e3, 0.005), (50e3, 0.005), (30e3, 0.01), (3e3, 0.3))
"""Duration and energy weights of the sweep; the last three are the paper's."""

PAPER_TABLE = {target: figures for (layout, target), figures in PAPER.items() if layout == "TO+MPC"}
"""Target -> landing error [m] and duration [s], mean and deviation: the paper's TO+MPC in its own model (Table III)."""

PAPER_FRONT = (
    (2.2, 50e3, 0.005, 0.413, 1.285, 0.044, 0.143),
    (2.2, 30e3, 0.005, 0.252, 1.394, 0.059, 0.100),
    (1.7, 30e3, 0.01, 0.087, 1.461, 0.044, 0.071),
    (1.7, 3e3, 0.3, 0.027, 2.128, 0.037, 0.004),
)
"""Release speed [m/s], w_t, rho, landing error [m], duration [s], position [m] and velocity error [m/s] at release (Table IV)."""

CORNER = (2.5, 0.5)
"""Duration [s] and landing error [m] that hypervolumes are measured from."""


@dataclass(frozen=True)
class Study:
    """What is flown."""

    experiment: Experiment
    throws: int = 10
    seed: int = 0
    params: PlanParams = field(default_factory=PlanParams)

    @property
    def model(self) -> Pendulum:
        """The controller's model of the experiment's plant."""
        return pendulum_of(plant_of(self.experiment))

    def plan(self, target: float, height: float, speed: float, w_t: float, rho: float) -> Plan:
        """Plan one throw; its release suits the compensated latch."""
        weights, release = replace(self.params, duration=w_t, energy=rho), self.experiment.release
        period = self.experiment.sim.control_period
        return plan_throw(self.model, target, height, speed, weights, release.landing_height, period, release.lag)

    def flown(self, plan: Plan, plant: str, compensation: str) -> Flown:
        """Fly a plan."""
        if plant == "pendulum":
            return fly_pendulum(plan, self.throws, self.seed, self.experiment.release.landing_height)
        return fly_plant(plan, plant, self.experiment, delays_of(self.experiment, compensation), self.throws, self.seed)

    def fly(self, plan: Plan, plant: str, compensation: str) -> dict:
        """Fly a plan and describe the result as one row."""
        settings = {
            "plant": plant, "compensation": compensation, "target": plan.target, "planned": plan.duration,
            "speed": float(plan.release.vel_w[0]), "height": float(plan.release.pos_w[2]),
            "w_t": plan.params.duration, "rho": plan.params.energy,
        }  # fmt: skip
        return {**settings, **self.flown(plan, plant, compensation).summary()}


Progress = Callable[[str], None]


def by_target(
    study: Study, targets: Sequence[float], plants: Sequence[str], compensations: Sequence[str], say: Progress,
    releases: dict[float, tuple[float, float]] | None = None,
) -> list[dict]:  # fmt: skip
    """Throw at targets with the learnt policy's release height and speed: own model first, then each plant.

    Args:
        study: what is flown.
        targets: [m].
        plants: names beside the own model.
        compensations: on those plants.
        say: told what comes next.
        releases: target -> height [m] and speed [m/s]; the shipped state policy's where missing.
    """
    rows = []
    for target in targets:
        height, speed = (releases or {}).get(target) or default_release(target)
        say(f"planning the throw at {target:g} m")
        plan = study.plan(target, height, speed, study.params.duration, study.params.energy)
        for plant, compensation in [("pendulum", "none"), *((p, c) for p in plants for c in compensations)]:
            say(f"{target:g} m: {plant}, compensation {compensation}")
            rows.append(study.fly(plan, plant, compensation))
    return rows


def sweep(
    study: Study,
    target: float,
    speeds: Sequence[float],
    weights: Sequence[tuple[float, float]],
    plants: Sequence[str],
    say: Progress,
) -> list[dict]:
    """Sweep release speed and weights at one target: in the own model and, all delays made up for, on plants."""
    height, rows = default_release(target)[0], []
    for i, speed in enumerate(speeds):
        for j, (w_t, rho) in enumerate(weights):
            say(f"sweep: {i * len(weights) + j + 1} of {len(speeds) * len(weights)}")
            plan = study.plan(target, height, speed, w_t, rho)
            rows.append(study.fly(plan, "pendulum", "none"))
            rows += [study.fly(plan, plant, "both") for plant in plants]
    return rows


def hypervolume(points: np.ndarray, corner: tuple[float, float] = CORNER) -> float:
    """Area between points (N, 2), smaller is better, and a corner [s m]."""
    inside = points[np.all(points < corner, axis=1)] if len(points) else points
    front = inside[pareto(inside)] if len(inside) else inside
    right = np.append(front[1:, 0], corner[0]) if len(front) else front
    return float(((right - front[:, 0]) * (corner[1] - front[:, 1])).sum()) if len(front) else 0.0


def points_of(rows: Sequence[dict]) -> np.ndarray:
    """Duration and landing error of rows whose throws all landed, shape (N, 2)."""
    return np.array([(r["duration_mean"], r["error_mean"]) for r in rows if r["success"] == 1.0]).reshape(-1, 2)


def correlation(rows: Sequence[dict]) -> dict[str, float]:
    """Pearson and rank correlation of mean landing error with mean velocity error at release, over configurations."""
    from scipy.stats import pearsonr, spearmanr

    good = [r for r in rows if r["success"] == 1.0]
    if len(good) < 3:
        return {"configurations": len(good)}
    error, velocity = ([r[name] for r in good] for name in ("error_mean", "velocity_error_mean"))
    return {
        "configurations": len(good),
        "pearson": float(pearsonr(velocity, error).statistic),
        "spearman": float(spearmanr(velocity, error).statistic),
    }


def summary(swept: Sequence[dict], policies: Sequence[dict]) -> dict[str, dict]:
    """For each plant of the sweep: correlation, hypervolumes, and whether a configuration beats a policy.

    Args:
        swept: rows of :func:`sweep`.
        policies: rows of learnt policies with ``policy``, ``plant``, ``duration_mean`` and ``error_mean``.
    """
    out: dict[str, dict] = {}
    for plant in dict.fromkeys(row["plant"] for row in swept):
        rows = [row for row in swept if row["plant"] == plant]
        points = points_of(rows)
        out[plant] = {**correlation(rows), "landed_all": len(points), "hypervolume": hypervolume(points)}
        if len(points):
            out[plant] |= {"fastest_s": float(points[:, 0].min()), "most_accurate_m": float(points[:, 1].min())}
        for row in policies:
            own = np.array([row["duration_mean"], row["error_mean"]])
            name = f"{row['policy']} on {row['plant']}"
            out[plant][f"beats {name}"] = bool(np.any(np.all(points <= own, axis=1)))
            out[plant][f"slower than {name}"] = bool(np.all(points[:, 0] > own[0]))
    for row in policies:
        point = np.array([[row["duration_mean"], row["error_mean"]]])
        out.setdefault("policies", {})[f"hypervolume, {row['policy']} on {row['plant']}"] = hypervolume(point)
    return out
