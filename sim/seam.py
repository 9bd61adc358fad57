"""The fused chain behind the hybrid's seam: what :class:`sim.reference.seam.Bodies` asks, of the batched simulator."""

import dataclasses

import numpy as np

from sim.hybrid import HybridSim
from sim.params import PlantParams
from sim.reference.seam import Root


class FusedChain:
    """The batched simulator with its blocks left out: a wrench in, the root's kinematics out.

    Inside :class:`sim.hybrid.HybridSim` blocks and rope are one kernel, which is what makes it fast; here the blocks stand outside,
    as they do for any other solver.

    Args:
        params: Of the plant; commands, motors, battery and aerodynamics do not count.
        count: E.
        interval: Between two exchanges [s]; ``advance`` goes on by whole ones.
        device: "cpu" or "cuda:0".
    """

    def __init__(self, params: PlantParams, count: int = 1, interval: float = 0.002, device: str = "cpu") -> None:
        numerics = dataclasses.replace(params.sim, control_period=interval, substep=min(params.sim.substep, interval))
        queue = dataclasses.replace(params.vehicle.queue, delay=0.0)
        vehicle = dataclasses.replace(params.vehicle, queue=queue, aero=dataclasses.replace(params.vehicle.aero, kind="none"))
        self.sim = HybridSim(dataclasses.replace(params, sim=numerics, vehicle=vehicle), count, device, direct=True)
        self.count, self.interval, self.total_mass = count, interval, params.total_mass

    def root(self) -> Root:
        """See `Bodies`."""
        return Root(*(self.sim.get(name).astype(float) for name in ("pos_w", "quat_wb", "vel_w", "rate_b")))

    def payload_w(self) -> np.ndarray:
        """See `Bodies`."""
        return self.sim.get("payload_pos_w").astype(float)

    def advance(self, force_b: np.ndarray, torque_b: np.ndarray, duration: float) -> None:
        """See `Bodies`.

        Raises:
            ValueError: A duration that is no whole number of intervals, or a force across body z, which the kernel has no place for:
                its own blocks work there.
        """
        force_b, torque_b = (np.broadcast_to(np.asarray(v, dtype=float), (self.count, 3)) for v in (force_b, torque_b))
        steps = round(duration / self.interval)
        if abs(steps * self.interval - duration) > 1e-9:
            raise ValueError(f"{duration} s is no whole number of intervals of {self.interval} s")
        if np.any(force_b[:, :2]):
            across = np.abs(force_b[:, :2]).max()
            raise ValueError(f"force across body z of {across:g} N; expected 0: the fused chain takes thrust and torque")
        self.sim.set_command(np.column_stack([force_b[:, 2], torque_b]))
        for _ in range(steps):
            self.sim.step()
