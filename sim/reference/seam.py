"""The seam of the paper's hybrid (Sec. III-B): a solver holds the bodies, the quadrotor's blocks give one wrench a substep.

What hangs below a vehicle is a matter of the solver alone: the fused chain of the batched simulator
(:class:`sim.seam.FusedChain`), or MuJoCo's bodies (:mod:`sim.reference.bodies`): a rope with a ball, a box, two cables. Blocks see the
root's kinematics, the solver sees a wrench, and nothing else passes.
"""

from typing import NamedTuple, Protocol

import numpy as np

from sim.params import VehicleParams
from sim.reference import blocks
from sim.reference.quadrotor import VehicleErrors, initial_blocks, vehicle_rates
from sim.reference.rotations import rotation_from_quat, turned_back


class Root(NamedTuple):
    """Kinematics of E vehicles' centres of mass; world frame, quaternions xyzw."""

    pos_w: np.ndarray  # [m], shape (E, 3)
    quat_wb: np.ndarray  # shape (E, 4)
    vel_w: np.ndarray  # [m/s], shape (E, 3)
    rate_b: np.ndarray  # [rad/s], body frame, shape (E, 3)


class Bodies(Protocol):
    """A solver of E vehicles' rigid bodies with what hangs on them."""

    count: int  # E
    total_mass: float  # of a vehicle with all that hangs on it [kg]

    def root(self) -> Root:
        """Kinematics now."""

    def payload_w(self) -> np.ndarray:
        """Centres of the payloads [m], shape (E, 3), world frame."""

    def advance(self, force_b: np.ndarray, torque_b: np.ndarray, duration: float) -> None:
        """Go on under a wrench that is held in the body frame.

        Args:
            force_b: Of the vehicle's own blocks, without gravity, at its centre of mass [N], shape (E, 3).
            torque_b: About the centre of mass [N m], shape (E, 3).
            duration: [s].
        """


class SeamSim:
    """Quadrotors on any bodies: the blocks' NumPy form, one wrench out and one root in every substep.

    Args:
        vehicle: Blocks; of its body the mass and inertia are the solver's.
        bodies: The solver.
        substep: Between two exchanges [s]; the paper's is 2 ms.
        control_period: Of the commands [s].

    Raises:
        ValueError: A period that is no whole number of substeps.
    """

    def __init__(self, vehicle: VehicleParams, bodies: Bodies, substep: float = 0.002, control_period: float = 0.02) -> None:
        self.substeps = round(control_period / substep)
        if self.substeps < 1 or abs(self.substeps * substep - control_period) > 1e-9:
            raise ValueError(f"control period {control_period} s; expected a whole number of substeps of {substep} s")
        self.vehicle, self.bodies, self.substep, self.time = vehicle, bodies, substep, 0.0
        count = bodies.count
        self._errors, weight = VehicleErrors.none(count), np.full(count, bodies.total_mass * 9.81)
        self._blocks = initial_blocks(vehicle, bodies.root().rate_b, weight, np.zeros(count))
        self._times, self._commands = [np.full(count, -np.inf)], [np.column_stack([weight, np.zeros((count, 3))])]

    def step(self, command: np.ndarray) -> Root:
        """Give a command, which acts after the vehicle's delay, and go on for one control period.

        Args:
            command: Collective thrust [N] and body rates [rad/s], shape (E, 4).

        Returns:
            The root's kinematics then.
        """
        count = self.bodies.count
        self._times.append(np.full(count, self.time + self.vehicle.queue.delay))
        self._commands.append(np.broadcast_to(np.asarray(command, dtype=float), (count, 4)).copy())
        times, commands = np.array(self._times), np.array(self._commands)
        for k in range(self.substeps):
            now = np.full(count, self.time + (k + 0.5) * self.substep)
            acting = blocks.command_queue(times, commands, now)
            root = self.bodies.root()
            air_b = turned_back(rotation_from_quat(root.quat_wb), root.vel_w)
            force_b, torque_b, rates, _ = vehicle_rates(self.vehicle, self._errors, self._blocks, acting, air_b, root.rate_b)
            self.bodies.advance(force_b, torque_b, self.substep)
            self._blocks = self._blocks + self.substep * rates
        self.time += self.substeps * self.substep
        while len(self._times) > 1 and np.all(self._times[1] <= self.time):
            del self._times[0], self._commands[0]
        return self.bodies.root()
