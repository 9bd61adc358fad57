"""Nonlinear model-predictive controller of the pendulum, with one real-time iteration of SQP in
each control period.

The cost is a sum of squares over the horizon, of errors of payload, cable, attitude and input (the
paper, Sec. IV-A; weights are ours), with bounds on thrust and body rates. Each step linearises the
model about the previous solution, shifted by one period, and solves a sparse quadratic programme
with piqp's multistage factorisation.

Source: Diehl, Bock, Schloeder, "A real-time iteration scheme for nonlinear optimization in optimal
feedback control", SIAM J. Control Optim. 2005; Schwan, Jiang, Kuhn, Jones, "PIQP: A proximal
interior-point quadratic programming solver", CDC 2023."""

import time
from dataclasses import dataclass

import numpy as np
from numpy import ndarray
from scipy import sparse

from visthrow.common.errors import VisthrowError
from visthrow.paper.baseline import pendulum_model as pm
from visthrow.paper.baseline.pendulum_model import DIR, INPUTS, QUAT, STATES, Pendulum

WIDTH = STATES + INPUTS


class SolverError(VisthrowError):
    """The quadratic programme was not solved."""


@dataclass(frozen=True)
class MPCParams:
    """Horizon, scales of the errors (a weight is the inverse square of a scale), and bounds."""

    period: float = 0.02  # [s]
    stages: int = 62  # of one period each: 1.24 s, the paper's 1.25 s rounded to whole periods
    position: float = 0.045  # of the payload [m]
    velocity: float = 0.15  # of the payload [m/s]
    direction: float = 0.15  # of the cable [-]
    rate: float = 1.0  # of the cable [rad/s]
    attitude: float = 0.3  # of the quaternion's components [-]
    thrust: float = 2.0  # deviation from the feed-forward [N]
    body_rate: float = 2.0  # deviation from the feed-forward [rad/s]
    min_thrust: float = 0.2  # [N]
    max_thrust: float = 14.0  # [N]
    max_rate: tuple[float, float, float] = (10.0, 10.0, 4.0)  # [rad/s]

    @property
    def state_weights(self) -> ndarray:
        """Return the weights of the state's errors, shape (16,)."""
        scale = np.repeat(
            [self.position, self.velocity, self.direction, self.rate, self.attitude],
            [3, 3, 3, 3, 4],
        )
        return scale**-2.0

    @property
    def input_weights(self) -> ndarray:
        """Return the weights of the input's errors, shape (4,)."""
        return np.array([self.thrust, *[self.body_rate] * 3]) ** -2.0


class MPC:
    """The controller of one vehicle."""

    def __init__(self, model: Pendulum, params: MPCParams | None = None):
        """Build the sparsity pattern of the quadratic programme, which is factorised symbolically
        once.

        Raises ModuleNotFoundError: piqp is not installed.
        """
        import piqp

        self.model = model
        self.params = params or MPCParams()
        n = self.params.stages
        size = n * WIDTH + STATES
        weights = np.concatenate([self.params.state_weights, self.params.input_weights])
        self._weights = np.concatenate([np.tile(weights, n), self.params.state_weights])
        self._rows_columns()
        free = np.full(STATES, np.inf)
        last = np.full(STATES, np.inf)
        limit = np.array(self.params.max_rate)
        low = np.concatenate([*[np.r_[-free, self.params.min_thrust, -limit]] * n, -last])
        high = np.concatenate([*[np.r_[free, self.params.max_thrust, limit]] * n, last])
        self._bounds = low, high
        self._solver = piqp.SparseSolver()
        settings = self._solver.settings
        settings.kkt_solver = piqp.KKTSolver.sparse_multistage
        settings.eps_abs = 1e-6
        settings.eps_rel = 1e-8
        settings.check_duality_gap = False
        self._solved = piqp.PIQP_SOLVED
        self.reset()
        self._set_up(np.zeros(size), np.zeros(self._matrix.shape[0]))

    def reset(self) -> None:
        """Discard the previous solution."""
        self._states = self._inputs = None
        self.step_time = 0.0

    def _rows_columns(self) -> None:
        """Build the pattern of the constraints: the first rows fix x_0; the rows of stage k contain
        -[A B] for stage k and the identity for stage k + 1.
        """
        n = self.params.stages
        eye = np.arange(STATES)
        places = [(eye, eye)]
        for k in range(n):
            row, column = np.indices((STATES, WIDTH)).reshape(2, -1)
            places.append((row + (k + 1) * STATES, column + k * WIDTH))
            places.append((eye + (k + 1) * STATES, eye + (k + 1) * WIDTH))
        row, column = np.concatenate(places, axis=1)
        numbered = sparse.csc_matrix((np.arange(len(row)), (row, column)))
        self._order = numbered.data
        self._matrix = sparse.csc_matrix((np.ones(len(row)), numbered.indices, numbered.indptr))

    def _fill(self, by_state: ndarray, by_input: ndarray) -> None:
        n = self.params.stages
        blocks = np.concatenate([-by_state, -by_input], axis=2).reshape(n, -1)
        values = np.concatenate([blocks, np.ones((n, STATES))], axis=1).ravel()
        self._matrix.data[:] = np.concatenate([np.ones(STATES), values])[self._order]

    def step(self, state: ndarray, reference: tuple[ndarray, ndarray]) -> ndarray:
        """Do one real-time iteration and return the command [N, rad/s] for the next period, shape
        (4,).

        Raises SolverError: the programme was not solved; the message contains the solver's status.

        Args:
            state: present state, shape (16,).
            reference: states (N + 1, 16) at the boundaries of the stages, and their inputs (N, 4).
        """
        began = time.perf_counter()
        n = self.params.stages
        target, effort = reference
        if self._states is None:
            self._states = target.copy()
            self._inputs = effort.copy()
        state, *target = _align_signs(
            np.vstack([state, target]), np.vstack([self._states[:1], self._states])
        )
        target = np.array(target)
        moved, by_state, by_input = pm.linearise(
            self.model, self._states[:n], self._inputs, self.params.period
        )
        self._fill(by_state, by_input)
        free = (
            moved
            - np.einsum("kij,kj->ki", by_state, self._states[:n])
            - np.einsum("kij,kj->ki", by_input, self._inputs)
        )
        setpoints = np.concatenate(
            [np.concatenate([target[:n], effort], axis=1).ravel(), target[n]]
        )
        solution = self._solve(-self._weights * setpoints, np.concatenate([state, free.ravel()]))
        stages = solution[: n * WIDTH].reshape(n, WIDTH)
        states = np.concatenate([stages[:, :STATES], solution[None, n * WIDTH :]])
        inputs = stages[:, STATES:]
        command = inputs[0].copy()
        self._move_on(states, inputs)
        self.step_time = time.perf_counter() - began
        return command

    def _solve(self, linear: ndarray, right: ndarray) -> ndarray:
        if self._ready:
            self._solver.update(c=linear, A=self._matrix, b=right)
        else:
            self._set_up(linear, right)
        status = self._solver.solve()
        if status != self._solved:
            self._ready = False
            raise SolverError(
                f"the controller's quadratic programme ended with {status}; expected {self._solved}"
            )
        return np.asarray(self._solver.result.x)

    def _set_up(self, linear: ndarray, right: ndarray) -> None:
        """Pass the whole programme with its pattern to the solver; later only numbers change."""
        low, high = self._bounds
        cost = sparse.diags(self._weights, format="csc")
        self._solver.setup(cost, linear, self._matrix, right, x_l=low, x_u=high)
        self._ready = True

    def _move_on(self, states: ndarray, inputs: ndarray) -> None:
        """Store the solution shifted by one period, with its last input repeated and directions and
        quaternions normalised.
        """
        self._inputs = np.concatenate([inputs[1:], inputs[-1:]])
        self._states = np.concatenate(
            [states[1:], pm.step(self.model, states[-1], inputs[-1], self.params.period)[None]]
        )
        for part in (DIR, QUAT):
            self._states[:, part] /= np.linalg.norm(self._states[:, part], axis=1, keepdims=True)


def _align_signs(target: ndarray, reference: ndarray) -> ndarray:
    """Return states whose quaternions have the signs of the reference's, as q and -q are the same
    attitude.
    """
    target = target.copy()
    sign = np.sign((target[:, QUAT] * reference[:, QUAT]).sum(1))
    target[:, QUAT] *= np.where(sign == 0.0, 1.0, sign)[:, None]
    return target
