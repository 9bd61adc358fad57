"""The baseline's model: a point mass on a massless, taut, inextensible cable below a quadrotor that
follows body rates exactly.

The state has 16 numbers: payload position p and velocity v (world), cable direction q from vehicle
to payload and its angular velocity w (world, perpendicular to q), attitude quaternion (xyzw, body
to world). The input has 4: collective thrust c [N] and body rates [rad/s]. With the masses M of the
vehicle and m of the payload, the cable length l, and ``b`` the body's z axis:

- ``p' = v``, ``(M + m) (v' + g e_z) = (q . c b - M l |w|^2) q``
- ``q' = w x q``, ``M l w' = -q x c b``
- ``quat' = quat * (rates, 0) / 2``

Source: Sreenath, Lee, Kumar, "Geometric control and differential flatness of a quadrotor UAV with a
cable-suspended load", CDC 2013, eqs. (5) to (8), with the attitude driven by commanded rates. The
paper's baseline (Sec. IV-A) uses the same sixteen states but does not print the equations."""

from dataclasses import dataclass

import numpy as np
from numpy import ndarray

from sim.params import GRAVITY, PlantParams

STATES = 16
INPUTS = 4
# parts of the state
POS = slice(0, 3)
VEL = slice(3, 6)
DIR = slice(6, 9)
RATE = slice(9, 12)
QUAT = slice(12, 16)

_SUCCESSOR = [1, 2, 0]  # axes of a cross product
_LAST = [2, 0, 1]

_TINY = 1e-30  # complex step, for which the derivative's truncation error is negligible


@dataclass(frozen=True)
class Pendulum:
    """Masses [kg], and length of the cable from its mount to the payload's centre [m]."""

    vehicle_mass: float
    payload_mass: float
    length: float

    @property
    def weight(self) -> float:
        """Return the weight of both bodies [N]."""
        return (self.vehicle_mass + self.payload_mass) * GRAVITY


def pendulum_of(plant: PlantParams) -> Pendulum:
    """Return the pendulum of a plant, with half of the rope's mass at each end."""
    rope = plant.rope
    half = 0.5 * plant.rope.rope_mass
    return Pendulum(
        plant.vehicle.body.mass + half, rope.payload_mass + half, rope.length + rope.payload_offset
    )


def derivative(model: Pendulum, state: ndarray, control: ndarray) -> ndarray:
    """Return the time derivative of states, shape (16, ...), for thrust [N] and body rates [rad/s],
    shape (4, ...); real or complex.
    """
    direction = state[DIR]
    rate = state[RATE]
    x, y, z, w = state[QUAT]
    thrust, p, q, r = control
    axis = np.array([2.0 * (x * z + w * y), 2.0 * (y * z - w * x), 1.0 - 2.0 * (x * x + y * y)])
    lever = model.vehicle_mass * model.length
    along_cable = thrust * (direction * axis).sum(0)
    inward = lever * (rate * rate).sum(0)
    pull = (along_cable - inward) / (model.vehicle_mass + model.payload_mass)
    out = np.empty_like(state)
    out[POS] = state[VEL]
    out[VEL] = pull * direction
    out[5] -= GRAVITY
    out[DIR] = _cross(rate, direction)
    out[RATE] = -thrust / lever * _cross(direction, axis)
    out[12] = 0.5 * (w * p + y * r - z * q)
    out[13] = 0.5 * (w * q + z * p - x * r)
    out[14] = 0.5 * (w * r + x * q - y * p)
    out[15] = -0.5 * (x * p + y * q + z * r)
    return out


def _cross(a: ndarray, b: ndarray) -> ndarray:
    """Return the cross product of vectors, shape (3, ...) each."""
    return a[_SUCCESSOR] * b[_LAST] - a[_LAST] * b[_SUCCESSOR]


def normalise(columns: ndarray) -> None:
    """Normalise direction and quaternion of states, shape (16, ...), and make the cable's rate
    perpendicular to its direction, in place; without conjugates, for the complex step.
    """
    direction = columns[DIR]
    direction /= np.sqrt((direction * direction).sum(0))
    columns[RATE] -= direction * (direction * columns[RATE]).sum(0)
    columns[QUAT] /= np.sqrt((columns[QUAT] * columns[QUAT]).sum(0))


def _advance(model: Pendulum, state: ndarray, control: ndarray, period: float) -> ndarray:
    """Do one step of the classical Runge-Kutta method, then :func:`normalise`."""
    k1 = derivative(model, state, control)
    k2 = derivative(model, state + (0.5 * period) * k1, control)
    k3 = derivative(model, state + (0.5 * period) * k2, control)
    k4 = derivative(model, state + period * k3, control)
    out = state + (period / 6.0) * (k1 + 2.0 * (k2 + k3) + k4)
    normalise(out)
    return out


def step(
    model: Pendulum, state: ndarray, control: ndarray, period: float, substeps: int = 1
) -> ndarray:
    """Advance states, shape (..., 16), with constant inputs, shape (..., 4), over a period [s] in
    ``substeps`` Runge-Kutta steps.
    """
    columns = np.moveaxis(state, -1, 0)
    inputs = np.moveaxis(control, -1, 0)
    for _ in range(substeps):
        columns = _advance(model, columns, inputs, period / substeps)
    return np.moveaxis(columns, 0, -1)


def linearise(
    model: Pendulum, state: ndarray, control: ndarray, period: float
) -> tuple[ndarray, ndarray, ndarray]:
    """Do one Runge-Kutta step of states (K, 16) with inputs (K, 4), and compute its Jacobians by
    complex steps, exact to rounding.

    Returns next states (K, 16), Jacobians by state (K, 16, 16) and by input (K, 16, 4).

    Source: Squire and Trapp, "Using complex variables to estimate derivatives of real functions",
    SIAM Review 1998."""
    stacked = np.concatenate([state.T, control.T])  # (20, K)
    count = stacked.shape[1]
    width = STATES + INPUTS
    lifted = np.repeat(stacked[:, None, :], width, axis=1).astype(complex)  # (20, direction, K)
    index = np.arange(width)
    lifted[index, index] += 1j * _TINY
    flat = lifted.reshape(width, width * count)
    moved = _advance(model, flat[:STATES], flat[STATES:], period).reshape(STATES, width, count)
    slope = moved.imag.transpose(2, 0, 1) / _TINY
    return moved[:, 0].real.T, slope[:, :, :STATES], slope[:, :, STATES:]


def tension(model: Pendulum, state: ndarray, control: ndarray) -> ndarray:
    """Return the cable's tension [N], shape (...); the model is not valid where it is negative."""
    pull = derivative(model, np.moveaxis(state, -1, 0), np.moveaxis(control, -1, 0))[3:6].copy()
    pull[2] += GRAVITY
    return -model.payload_mass * (pull * np.moveaxis(state, -1, 0)[DIR]).sum(0)


def hover(model: Pendulum, payload_w: ndarray) -> tuple[ndarray, ndarray]:
    """Return state (..., 16) and input (..., 4) of a hover with the payload at positions [m], shape
    (..., 3).
    """
    payload_w = np.asarray(payload_w, dtype=float)
    state = np.zeros((*payload_w.shape[:-1], STATES))
    state[..., POS] = payload_w
    state[..., 8] = -1.0
    state[..., 15] = 1.0
    control = np.zeros((*payload_w.shape[:-1], INPUTS))
    control[..., 0] = model.weight
    return state, control
