"""The paper's measurement: throws from hover at targets in front, scored by landing error and
duration.

The landing error is the horizontal distance of the landing point from the goal. The duration is the
time from the policy's start to the landing (Sec. IV-A). A throw succeeds if the payload was
released and landed. Otherwise it has no landing error and lowers the success rate."""

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
from numpy import ndarray

from sim.params import RandomizationParams
from visthrow import config
from visthrow.task import Experiment

TARGETS = (1.5, 2.0, 2.5)  # targets along x [m]; the last is outside the training distribution

LANDED = 0.95  # share of throws that must land for their mean error to be meaningful


def pilots_hover() -> RandomizationParams:
    """Return the variation of initial states in a hover, ``configs/start/hover.toml``."""
    return config.load(RandomizationParams, config.find("start", "hover"))


def hover_start(experiment: Experiment) -> Experiment:
    """Return the experiment with episodes that start from hover; cables and payloads still vary as
    the experiment specifies.
    """
    fields = (
        "tether_variants",
        "tether_spread",
        "payload_variants",
        "payload_spread",
        "drag_spread",
    )
    drawn = {name: getattr(experiment.task.start, name) for name in fields}
    start = replace(pilots_hover(), **drawn)
    task = replace(experiment.task, start=start)
    return replace(experiment, task=task)


def as_flown(experiment: Experiment) -> Experiment:
    """Return the experiment with the changes in ``flown``, under which its policies are flown and
    measured: without the faults of the training.
    """
    if not experiment.flown:
        return experiment
    values = config.to_dict(experiment)
    name = "the configuration of the training"
    return config.load_dict(Experiment, values, experiment.flown, name=name)


def blank_failed(success: ndarray, columns: dict[str, ndarray]) -> dict[str, ndarray]:
    """Return columns, one row for each throw, with NaN in the rows of failed throws."""
    blank = np.where(success, 1.0, np.nan)
    return {name: (blank * values.T).T for name, values in columns.items()}


@dataclass(frozen=True)
class Throws:
    """Results of N throws at one target; entries of failed throws are NaN."""

    target: float  # [m] along x
    success: ndarray  # shape (N,), bool
    landing_w: ndarray  # [m], shape (N, 2)
    error: ndarray  # [m], shape (N,)
    duration: ndarray  # [s], shape (N,)
    clearance: ndarray  # [m], shape (N,)
    # root mean square change of the normalised commands from step to step, shape (N,)
    smoothness: ndarray
    # position of a moving goal at impact [m], shape (N, 2); None if goals do not move
    goal_w: ndarray | None = None

    def land_within(self, error: float) -> bool:
        """Return whether the mean error is at most ``error`` [m] and a share of at least
        :data:`LANDED` lands.
        """
        return (
            bool(self.success.mean() >= LANDED) and float(self.error[self.success].mean()) <= error
        )

    def summary(self) -> dict[str, float]:
        """Return means and standard deviations of the successful throws, and the success rate."""
        if not self.success.any():
            return {"target": self.target, "throws": len(self.success), "success": 0.0}
        good = self.success
        goal = np.array([[self.target, 0.0]]) if self.goal_w is None else self.goal_w[good]
        bias = (self.landing_w[good] - goal).mean(axis=0)
        error = self.error[good]
        duration = self.duration[good]
        return {
            "target": self.target,
            "throws": len(good),
            "success": float(good.mean()),
            "error_mean": float(error.mean()),
            "error_std": float(error.std()),
            "duration_mean": float(duration.mean()),
            "duration_std": float(duration.std()),
            "bias_x": float(bias[0]),
            "bias_y": float(bias[1]),
            "clearance_min": float(self.clearance[good].min()),
            "smoothness": float(self.smoothness[good].mean()),
        }


@dataclass(frozen=True)
class Entry:
    """One row of a comparison: the thrower's name, its layout of observations ("state", "vision")
    or its kind, and its throws for each target.
    """

    name: str
    layout: str
    throws: Sequence
