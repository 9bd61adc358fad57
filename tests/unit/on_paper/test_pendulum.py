"""The baseline's pendulum: Newton's law of each body, closed forms, constraints, Jacobians."""

import numpy as np
from numpy.linalg import norm
from numpy.testing import assert_allclose
from pytest import approx
from scipy.spatial.transform import Rotation

from sim.params import GRAVITY
from tests.plants import paper_plant
from visthrow.paper.baseline import pendulum_model as pm
from visthrow.paper.baseline.mpc import MPCParams
from visthrow.paper.baseline.pendulum_model import DIR, QUAT, RATE, VEL, Pendulum

MODEL = Pendulum(0.21, 0.06, 0.36)


def random_states(count: int, seed: int = 0) -> tuple[np.ndarray, np.ndarray]:
    rng = np.random.default_rng(seed)
    state = rng.standard_normal((count, pm.STATES))
    state[:, DIR] /= norm(state[:, DIR], axis=1, keepdims=True)
    state[:, RATE] -= (state[:, RATE] * state[:, DIR]).sum(1, keepdims=True) * state[:, DIR]
    state[:, QUAT] /= norm(state[:, QUAT], axis=1, keepdims=True)
    return state, np.column_stack(
        [rng.uniform(0.5, 8.0, count), rng.uniform(-5.0, 5.0, (count, 3))]
    )


def vehicle(model: Pendulum, state: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Position [m] and velocity [m/s] of the vehicle, shape (..., 3) each."""
    direction, rate = state[..., DIR], state[..., RATE]
    pos = state[..., pm.POS] - model.length * direction
    return pos, state[..., VEL] - model.length * np.cross(rate, direction)


def test_newton_holds_for_each_body_with_the_tension_between_them():
    """Vehicle and payload one by one:

    M a = c b - M g + T q, m a = -m g - T q, accelerations by differences.
    """
    state, control = random_states(20, 2)
    h = 1e-4
    ends = [pm.step(MODEL, state, control, s * h) for s in (1, -1)]
    pull = (pm.tension(MODEL, state, control)[:, None]) * state[:, DIR]
    acc = (ends[0][:, VEL] - ends[1][:, VEL]) / (2 * h)
    assert np.allclose(0.06 * acc, -pull - [0, 0, 0.06 * 9.81], atol=1e-4)
    acc = (vehicle(MODEL, ends[0])[1] - vehicle(MODEL, ends[1])[1]) / (2 * h)
    axis = Rotation.from_quat(state[:, QUAT]).apply([0.0, 0.0, 1.0])
    assert np.allclose(0.21 * acc, control[:, :1] * axis + pull - [0, 0, 0.21 * 9.81], atol=1e-3)


def test_jacobians_are_those_of_the_step():
    state, control = random_states(6, 5)
    moved, by_state, by_input = pm.linearise(MODEL, state, control, 0.02)
    assert np.allclose(moved, pm.step(MODEL, state, control, 0.02), atol=1e-14)
    h = 1e-6
    for i in range(pm.STATES + pm.INPUTS):
        change = np.zeros(pm.STATES + pm.INPUTS)
        change[i] = h
        ends = [
            pm.step(MODEL, state + s * change[:16], control + s * change[16:], 0.02)
            for s in (1, -1)
        ]
        slope = by_state[:, :, i] if i < pm.STATES else by_input[:, :, i - pm.STATES]
        assert np.allclose((ends[0] - ends[1]) / (2 * h), slope, atol=1e-7)


def test_the_pendulum_of_a_plant_has_half_of_the_rope_at_each_end():
    plant = paper_plant()
    pendulum = pm.pendulum_of(plant)
    half = 0.5 * plant.rope.rope_mass
    assert half > 0.0
    assert pendulum.vehicle_mass == approx(plant.vehicle.body.mass + half)
    assert pendulum.payload_mass == approx(plant.rope.payload_mass + half)
    assert pendulum.weight == approx(GRAVITY * plant.total_mass)


def test_an_error_as_large_as_its_scale_costs_one():
    params = MPCParams()
    errors = [params.position, params.velocity, params.direction, params.rate, params.attitude]
    costs = params.state_weights * np.repeat(errors, [3, 3, 3, 3, 4]) ** 2
    assert_allclose(costs, 1.0)
    inputs = np.array([params.thrust, *[params.body_rate] * 3])
    assert_allclose(params.input_weights * inputs**2, 1.0)
