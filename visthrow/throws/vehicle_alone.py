"""Fly the vehicle without rope, payload and policy."""

import numpy as np

from sim.hybrid import HybridSim
from visthrow import config
from visthrow.common import provenance
from visthrow.logs.flightlog import FlightLog, FlightRecorder
from visthrow.onboard.hover import HoverController, HoverParams
from visthrow.task import Experiment, plant_of

SECONDS = 6.0
CHANNELS = ("pos_w", "quat_wb", "vel_w", "rate_b", "motor_speed")


def fly_alone(
    experiment: Experiment,
    target: tuple[float, float],
    integrator: str,
    device: str,
) -> FlightLog:
    """Fly a quadrotor from its hover point to the point above a target, and hover there.

    Args:
        experiment: vehicle, air and numerics of the simulator.
        target: x and y [m], world frame.
        integrator: name in :data:`sim.hybrid.INTEGRATORS`. device: device of the simulator.

    Returns:
        The flight; ``meta["result"]["error"]`` is the final distance from the point [m].
    """
    vehicle = experiment.vehicle
    sim = HybridSim(plant_of(experiment), 1, device, without_rope=integrator)
    height = experiment.task.start.spawn_height
    goal_w = np.array([*target, height])
    sim.place(pos_w=np.array([[0.0, 0.0, height]]))
    limits = HoverParams(max_thrust=4.0 * vehicle.controller.max_thrust)
    period = experiment.sim.control_period
    hover = HoverController(limits, period)
    recorder = FlightRecorder({"config": config.to_dict(experiment), "integrator": integrator})
    for step in range(round(SECONDS / period) + 1):
        state = {name: sim.get(name)[0] for name in CHANNELS}
        motion = [state[name][None] for name in ("pos_w", "quat_wb", "vel_w")]
        command = hover.step(*motion, goal_w, vehicle.body.mass)
        recorder.add(step * period, **state, command=command[0], goal_w=goal_w)
        sim.set_command(command)
        sim.step()
    error = float(np.linalg.norm(state["pos_w"] - goal_w))
    recorder.meta |= {"result": {"error": error}, "provenance": provenance.collect()}
    return recorder.log()
