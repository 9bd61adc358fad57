"""The training simulator's vehicle for the fake autopilot (`hil.fakes.process`), which takes its plant from outside.

``hil`` imports no simulator; it is given ``"visthrow.throws.wire_plant:make"``.
"""

import dataclasses

import numpy as np

from visthrow.task import Experiment, plant_of
from visthrow.throws.loading import load_policy
from visthrow.throws.plants import HybridPlant, random_ropes

PERIOD = 0.005
"""Of the plant behind the wire [s]: commands that come between two control periods wait no longer than this."""


class WirePlant:
    """One vehicle with its payload; NumPy in and out, batch axis left out.

    Attributes:
        period: of a step [s]. home_w: hover point [m]. mass: with and without payload [kg].
        max_thrust: that a thrust of 1 stands for [N].
    """

    period = PERIOD

    def __init__(self, experiment: Experiment, seed: int) -> None:
        """Put the vehicle near its hover point, the rope swinging a little.

        Args:
            experiment: whose plant it is.
            seed: of the start.
        """
        observation = dataclasses.replace(experiment.task.observation, latency=(0.0, 0.0))
        fine = dataclasses.replace(
            experiment,
            sim=dataclasses.replace(experiment.sim, control_period=PERIOD),
            task=dataclasses.replace(experiment.task, observation=observation),
        )
        self._plant = HybridPlant(fine)
        self.home_w = np.array([0.0, 0.0, experiment.task.start.spawn_height])
        self.mass = (plant_of(experiment).total_mass, experiment.vehicle.body.mass)
        self.max_thrust = experiment.task.action.max_thrust
        rng = np.random.default_rng(seed)
        self._plant.reset(self.home_w + 0.1 * rng.uniform(-1, 1, (1, 3)), random_ropes(rng, 1, experiment.rope.segments, 0.05))

    def step(self, command: np.ndarray, release: bool, after: float = 0.0) -> None:
        """Advance by one period under collective thrust [N] and body rates [rad/s], shape (4,).

        Args:
            command: see above.
            release: whether the latch trips in this period, or has before.
            after: from the period's beginning to that [s].
        """
        first = release and not self._plant.state.latched[0]
        self._plant.step(np.asarray(command)[None], np.array([release]))
        if first and after > 0.0:
            self._plant.postpone(after)

    @property
    def time(self) -> float:
        """Since the start [s]."""
        return self._plant.time

    @property
    def state(self) -> dict[str, np.ndarray]:
        """pos_w, quat_wb, vel_w, rate_b, payload_pos_w, attached: the truth."""
        now = self._plant.state
        names = ("pos_w", "quat_wb", "vel_w", "rate_b", "payload_pos_w", "attached")
        return {name: getattr(now, name)[0] for name in names}

    @property
    def landing(self) -> dict[str, list[float] | float | None]:
        """Where and when the payload came down and let go, None where it did not."""
        now = self._plant.landing
        landed, apart = bool(now.landed[0]), float(now.separation_time[0])
        return {
            "landing_w": now.point_w[0].tolist() if landed else None,
            "landing_time": float(now.time[0]) if landed else None,
            "separation_time": None if np.isnan(apart) else apart,
        }


def make(policy: str, seed: int) -> WirePlant:
    """The plant that a policy was trained on.

    Args:
        policy: a shipped name or a file.
        seed: of the start.
    """
    return WirePlant(load_policy(policy).experiment, seed)
