"""The quadrotor's blocks against their float64 twin of the reference, which shares no code with
them.
"""

from dataclasses import replace
from functools import lru_cache

import numpy as np
from numpy.linalg import norm
from numpy.testing import assert_allclose
from pytest import approx, mark

from sim.hybrid import HybridSim
from sim.params import GRAVITY, QueueParams, VehicleParams
from sim.reference.quadrotor import (
    BODY,
    QUAT,
    RATE,
    VEL,
    VehicleErrors,
    initial_blocks,
    rigid_body_rates,
    vehicle_rates,
)
from sim.reference.rotation_arrays import rotation_from_quat, turned, turned_back
from tests.plants import paper_plant
from tests.simulators import bare_quadrotor, random_commands

WITHIN = 1e-3
"""After a second of full-range commands [m]; the vehicles tumble, so errors of the first instants
grow.
"""
SAME_EQUATIONS = 1e-6
"""Two float64 codes of one method at one step differ by round-off and by what tumbling makes of it
[m].
"""
COUNT = 8
SEEDS = (0, 1, 2)
STEPS, PERIOD = 50, 0.02
"""Of so many seconds: a new command every time."""
SUBSTEP = 2e-3
"""Of the training simulator [s]; the largest error is 0.6 mm there, 0.04 mm at 0.5 ms."""
STATES = {
    "pos_w": slice(0, 3),
    "quat_wb": slice(3, 7),
    "vel_w": slice(7, 10),
    "rate_b": slice(10, 13),
}


def vehicle_with(delay: float = 0.0213, **kinds: str) -> VehicleParams:
    """The paper's vehicle; its command switches inside a substep."""
    vehicle = replace(paper_plant().vehicle, queue=QueueParams(delay))
    parts = {name: replace(getattr(vehicle, name), kind=kind) for name, kind in kinds.items()}
    if kinds.get("controller") == "motor_mixing":
        parts["controller"] = replace(parts["controller"], gyro_share=(0.4, 0.5, 1.3))
    return replace(vehicle, **parts)


def rates(vehicle: VehicleParams, state: np.ndarray, command: np.ndarray) -> np.ndarray:
    """Time derivative of bodies and blocks, shape (E, 28)."""
    body = state[:, :BODY]
    rotation = rotation_from_quat(body[:, QUAT])
    errors = VehicleErrors(np.ones((len(state), 4)), np.zeros((len(state), 3)))
    air = turned_back(rotation, body[:, VEL])
    force, torque, of_blocks, _ = vehicle_rates(
        vehicle, errors, state[:, BODY:], command, air, body[:, RATE]
    )
    of_body = rigid_body_rates(vehicle, body, turned(rotation, force), torque)
    return np.hstack((of_body, of_blocks))


def integrated(vehicle, state, command, seconds: float, step: float) -> np.ndarray:
    """Classical Runge-Kutta steps of order 4 under one command."""
    count = int(np.ceil(seconds / step - 1e-6))
    for _ in range(count):
        h = seconds / count
        k1 = rates(vehicle, state, command)
        k2 = rates(vehicle, state + 0.5 * h * k1, command)
        k3 = rates(vehicle, state + 0.5 * h * k2, command)
        k4 = rates(vehicle, state + h * k3, command)
        state = state + h / 6.0 * (k1 + 2.0 * k2 + 2.0 * k3 + k4)
        state[:, QUAT] /= norm(state[:, QUAT], axis=1, keepdims=True)
    return state


@lru_cache
def reference(vehicle: VehicleParams, step: float, steps: int) -> tuple[np.ndarray, np.ndarray]:
    """Body, shape (E, 13), and blocks, shape (E, 15), after ``steps`` random commands, each of
    which acts a delay after it was given.
    """
    commands = all_commands(steps)
    count = commands.shape[1]
    weight = np.full(count, vehicle.body.mass * GRAVITY)
    body = np.tile([0.0] * 6 + [1.0] + [0.0] * 6, (count, 1))
    blocks = initial_blocks(vehicle, body[:, RATE], weight, np.zeros(count))
    state = np.hstack((body, blocks))
    hover = np.outer(weight, [1.0, 0.0, 0.0, 0.0])
    late, rest = divmod(vehicle.queue.delay, PERIOD)
    late = round(late)
    acting = [*[hover] * (late + 1), *commands]
    for k in range(steps):
        state = integrated(vehicle, state, acting[k], rest, step)
        state = integrated(vehicle, state, acting[k + 1], PERIOD - rest, step)
    return state[:, :BODY], state[:, BODY:]


def all_commands(steps: int) -> np.ndarray:
    """Commands of all seeds side by side, shape (steps, E, 4)."""
    return np.concatenate([random_commands(seed, steps, COUNT) for seed in SEEDS], axis=1)


def flown(vehicle: VehicleParams, step: float, steps: int, precision: str) -> HybridSim:
    commands = all_commands(steps)
    sim = bare_quadrotor(vehicle, commands.shape[1], "rk4", step, precision=precision)
    for command in commands:
        sim.set_command(command)
        sim.step()
    return sim


def test_a_second_of_full_range_commands():
    vehicle = vehicle_with()
    body, _ = reference(vehicle, 5e-4, STEPS)  # 0.03 mm from half of it
    apart = norm(flown(vehicle, SUBSTEP, STEPS, "float32").get("pos_w") - body[:, :3], axis=1)
    assert apart.max() < WITHIN
    assert norm(body[:, :3], axis=1).min() > 0.1, "the vehicles must have gone somewhere"


@mark.parametrize(
    "changes",
    [
        {},
        {"delay": 0.0},
        {"delay": 0.0467},
        {"delay": 0.04},
        {"controller": "geometric", "motor": "instant"},
        {"controller": "motor_mixing", "battery": "ideal", "aero": "none"},
    ],
    ids=str,
)
def test_every_state_of_every_block(changes):
    """Ten commands at one and the same step: all 28 numbers of the state."""
    vehicle = vehicle_with(**changes)
    body, blocks = reference(vehicle, 1e-3, 10)
    sim = flown(vehicle, 1e-3, 10, "float64")
    for name, columns in STATES.items():
        assert_allclose(sim.get(name), body[:, columns], atol=SAME_EQUATIONS * 100, err_msg=name)
    assert np.abs(sim.get("pos_w") - body[:, :3]).max() < SAME_EQUATIONS
    inner = {
        "setpoint": blocks[:, 0:3],
        "gyro": blocks[:, 3:6],
        "integral": blocks[:, 6:9],
        "voltage": blocks[:, 14],
    }
    if vehicle.controller.kind == "geometric":
        del inner["setpoint"], inner["gyro"]
    if vehicle.motor.kind == "first_order":
        inner["motor_speed"] = blocks[:, 9:13]
    for name, expected in inner.items():
        assert_allclose(sim.get(name), expected, rtol=1e-4, atol=1e-4, err_msg=name)
    assert_allclose(sim.get("charge_used"), blocks[:, 13], rtol=1e-6, atol=1e-12)


def test_orders_of_the_integrators():
    """Gentle commands keep the mixer off its limits, where order 1 and 4 can be seen; no other code
    is needed.
    """
    vehicle = vehicle_with(0.0213)

    def end(integrator, step):
        sim = bare_quadrotor(vehicle, 1, integrator, step, precision="float64")
        for command in ([3.0, 1.0, -0.5, 0.3], [2.0, -1.0, 0.5, -0.2], [2.5, 0.3, 1.0, 0.1]):
            sim.set_command([command])
            sim.step()
        return sim.get("pos_w")[0]

    for integrator, order in (("euler", 1.0), ("rk4", 4.0)):
        ends = [end(integrator, h) for h in (1e-3, 5e-4, 2.5e-4)]
        seen = np.log2(norm(ends[0] - ends[1]) / norm(ends[1] - ends[2]))
        assert seen == approx(order, abs=0.35)
