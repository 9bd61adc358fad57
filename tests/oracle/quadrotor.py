"""Quadrotors without a rope: the seven blocks of the reference plant on free rigid bodies, float64
RK4 in NumPy.
"""

from collections.abc import Callable
from itertools import pairwise

import numpy as np

from sim.params import GRAVITY, VehicleParams
from sim.reference import vehicle_blocks
from sim.reference.quadrotor import (
    BODY,
    VehicleErrors,
    initial_blocks,
    rigid_body_rates,
    vehicle_rates,
)
from sim.reference.rotation_arrays import rotation_from_quat, turned, turned_back


def rk4(
    rates: Callable[[np.ndarray], np.ndarray], state: np.ndarray, step: float | np.ndarray
) -> np.ndarray:
    """Take one classical Runge-Kutta step of order 4.

    Args:
        rates: function from state to its time derivative.
        state: shape (E, N).
        step: [s], a number or shape (E, 1).
    """
    k1 = rates(state)
    k2 = rates(state + 0.5 * step * k1)
    k3 = rates(state + 0.5 * step * k2)
    k4 = rates(state + step * k3)
    return state + step / 6.0 * (k1 + 2.0 * k2 + 2.0 * k3 + k4)


class ReferenceQuadrotor:
    """Quadrotors without ropes.

    Args:
        vehicle: parameters.
        count: E.
        step: largest integration step [s].
    """

    def __init__(self, vehicle: VehicleParams, count: int = 1, step: float = 5e-4) -> None:
        self.vehicle, self.count, self.step_size = vehicle, count, step
        self.errors = VehicleErrors(np.ones((count, 4)), np.zeros((count, 3)))
        self.force_w = np.zeros((count, 3))  # external, at the centre of mass [N]
        self.torque_b = np.zeros((count, 3))  # external, about the centre of mass [N m]
        self.reset(
            np.zeros((count, 3)),
            np.tile([0.0, 0.0, 0.0, 1.0], (count, 1)),
            np.zeros((count, 3)),
            np.zeros((count, 3)),
        )

    def reset(
        self, pos_w: np.ndarray, quat_wb: np.ndarray, vel_w: np.ndarray, rate_b: np.ndarray
    ) -> None:
        """Put all vehicles at a state with the rotors, battery and command queue in hover."""
        self.time = 0.0
        weight = np.full(self.count, self.vehicle.body.mass * GRAVITY)
        self.body = np.hstack((pos_w, quat_wb, vel_w, rate_b)).astype(np.float64)
        self.blocks = initial_blocks(
            self.vehicle, self.body[:, 10:13], weight, np.zeros(self.count)
        )
        hover = np.zeros((self.count, 4))
        hover[:, 0] = weight
        self._queue = [(-np.inf, hover)]

    def _rates(self, state: np.ndarray, command: np.ndarray) -> np.ndarray:
        body, rotation = state[:, :BODY], rotation_from_quat(state[:, 3:7])
        air = turned_back(rotation, body[:, 7:10])
        force, torque, block_rates, _ = vehicle_rates(
            self.vehicle, self.errors, state[:, BODY:], command, air, body[:, 10:13]
        )
        force_w = turned(rotation, force) + self.force_w
        return np.hstack(
            (rigid_body_rates(self.vehicle, body, force_w, torque + self.torque_b), block_rates)
        )

    def step(self, command: np.ndarray, period: float = 0.02) -> None:
        """Give a command now and advance one control period.

        Args:
            command: collective thrust [N] and body rates [rad/s], shape (E, 4).
            period: [s].
        """
        self._queue.append(
            (self.time + self.vehicle.queue.delay, np.array(command, dtype=np.float64))
        )
        end = self.time + period
        edges = [
            self.time,
            *[
                t
                for t, _ in self._queue
                if self.time + vehicle_blocks.TIME_TOLERANCE
                < t
                < end - vehicle_blocks.TIME_TOLERANCE
            ],
            end,
        ]
        state = np.hstack((self.body, self.blocks))
        for start, stop in pairwise(edges):
            acting = [c for t, c in self._queue if t <= start + vehicle_blocks.TIME_TOLERANCE][-1]
            count = int(np.ceil((stop - start) / self.step_size - 1e-6))
            for _ in range(count):
                state = rk4(
                    lambda x, acting=acting: self._rates(x, acting), state, (stop - start) / count
                )
                state[:, 3:7] /= np.linalg.norm(state[:, 3:7], axis=1, keepdims=True)
        self.body, self.blocks = state[:, :BODY], state[:, BODY:]
        self.time = end
        past = [i for i, (t, _) in enumerate(self._queue) if t <= end]
        self._queue = self._queue[past[-1] :]
