"""The seam of the paper's hybrid (Sec.

III-B): a solver holds the bodies, the quadrotor's blocks give one wrench a substep.

What hangs below a vehicle is a matter of the solver alone: the fused chain of the batched
simulator, or MuJoCo's bodies (:mod:`sim.reference.bodies`): a rope with a ball, a box, two cables.
Blocks see the root's kinematics, the solver sees a wrench, and nothing else passes.

The price, on one core with 256 vehicles and an exchange each 2 ms: MuJoCo C (RK4, 0.5 ms, its
converged step) takes 68 to 86 times as long as the fused chain, three runs; MuJoCo Warp, one
vehicle, 770 times (``pytest -s -m slow tests/oracle/test_seam.py``). On an H200 MuJoCo Warp takes
19 times as long as the chain there (``-m gpu``)."""

import dataclasses
from typing import Protocol

import numpy as np

from sim.hybrid import HybridSim
from sim.params import GRAVITY, PlantParams, VehicleParams
from sim.reference import blocks
from sim.reference.quadrotor import VehicleErrors, initial_blocks, vehicle_rates
from sim.reference.rotations import rotation_from_quat, turned_back
from sim.reference.state import Root


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
            force_b: Of the vehicle's own blocks, without gravity, at its centre of mass [N], shape
                (E, 3).
            torque_b: About the centre of mass [N m], shape (E, 3).
            duration: [s].
        """


class SeamSim:
    """Quadrotors on any bodies: the blocks' NumPy form, one wrench out and one root in every
    substep.

    Raises ValueError: a period that is no whole number of substeps.

    Args:
        vehicle: Blocks; of its body the mass and inertia are the solver's.
        bodies: The solver.
        substep: Between two exchanges [s]; the paper's is 2 ms.
        control_period: Of the commands [s].
    """

    def __init__(
        self,
        vehicle: VehicleParams,
        bodies: Bodies,
        substep: float = 0.002,
        control_period: float = 0.02,
    ) -> None:
        self.substeps = round(control_period / substep)
        if self.substeps < 1 or abs(self.substeps * substep - control_period) > 1e-9:
            raise ValueError(
                f"control period {control_period} s; expected a whole number of substeps of"
                f" {substep} s"
            )
        self.vehicle, self.bodies, self.substep, self.time = vehicle, bodies, substep, 0.0
        count = bodies.count
        self._errors, weight = (
            VehicleErrors.none(count),
            np.full(count, bodies.total_mass * GRAVITY),
        )
        self._blocks = initial_blocks(vehicle, bodies.root().rate_b, weight, np.zeros(count))
        self._times, self._commands = (
            [np.full(count, -np.inf)],
            [np.column_stack([weight, np.zeros((count, 3))])],
        )

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
            force_b, torque_b, rates, _ = vehicle_rates(
                self.vehicle, self._errors, self._blocks, acting, air_b, root.rate_b
            )
            self.bodies.advance(force_b, torque_b, self.substep)
            self._blocks = self._blocks + self.substep * rates
        self.time += self.substeps * self.substep
        while len(self._times) > 1 and np.all(self._times[1] <= self.time):
            del self._times[0], self._commands[0]
        return self.bodies.root()


class FusedChain:
    """The batched simulator with its blocks left out: a wrench in, the root's kinematics out.

    Inside :class:`sim.hybrid.HybridSim` blocks and rope are one kernel, which is what makes it
    fast; here the blocks stand outside, as they do for any other solver.

    Args:
        params: Of the plant; commands, motors, battery and aerodynamics do not count.
        count: E.
        interval: Between two exchanges [s]; ``advance`` goes on by whole ones.
        device: "cpu" or "cuda:0".
    """

    def __init__(
        self, params: PlantParams, count: int = 1, interval: float = 0.002, device: str = "cpu"
    ) -> None:
        numerics = dataclasses.replace(
            params.sim, control_period=interval, substep=min(params.sim.substep, interval)
        )
        queue = dataclasses.replace(params.vehicle.queue, delay=0.0)
        vehicle = dataclasses.replace(
            params.vehicle, queue=queue, aero=dataclasses.replace(params.vehicle.aero, kind="none")
        )
        self.sim = HybridSim(
            dataclasses.replace(params, sim=numerics, vehicle=vehicle), count, device, direct=True
        )
        self.count, self.interval, self.total_mass = count, interval, params.total_mass

    def root(self) -> Root:
        return Root(
            *(self.sim.get(name).astype(float) for name in ("pos_w", "quat_wb", "vel_w", "rate_b"))
        )

    def payload_w(self) -> np.ndarray:
        return self.sim.get("payload_pos_w").astype(float)

    def advance(self, force_b: np.ndarray, torque_b: np.ndarray, duration: float) -> None:
        """See `Bodies`.

        Raises ValueError: a duration that is no whole number of intervals, or a force across body
        z, which the kernel has no place for: its own blocks work there."""
        force_b, torque_b = (
            np.broadcast_to(np.asarray(v, dtype=float), (self.count, 3))
            for v in (force_b, torque_b)
        )
        steps = round(duration / self.interval)
        if abs(steps * self.interval - duration) > 1e-9:
            raise ValueError(f"{duration} s is no whole number of intervals of {self.interval} s")
        if np.any(force_b[:, :2]):
            across = np.abs(force_b[:, :2]).max()
            raise ValueError(
                f"force across body z of {across:g} N; expected 0: the fused chain takes thrust and"
                " torque"
            )
        self.sim.set_command(np.column_stack([force_b[:, 2], torque_b]))
        for _ in range(steps):
            self.sim.step()
