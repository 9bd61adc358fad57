"""Scenes on the plant's own rope: ball joints without twist, own RK4, no fold at 90 deg; slower
than ``oracle``.

Held against ``oracle.converged`` it shows what twist in the joints is worth and that the plant's
rope is right."""

import functools

import numpy as np

from sim.reference.rope import RopeDynamics
from sim.reference.rotation_arrays import cross, quat_dot, rotation_from_quat, turned
from sim.reference.stepping import halving_rk4
from tests.oracle.start import vehicle_and_rope
from tests.scenes import Scene, wrench_at


class BareScene:
    """A scene in time.

    Args:
        scene: quadrotor, rope and schedule.
        step: largest integration step [s]; steps end on switches.
    """

    def __init__(self, scene: Scene, step: float = 2.5e-4) -> None:
        self.scene, self.step_size, self.time = scene, step, 0.0
        vehicle, rope = vehicle_and_rope(scene)
        self._ropes = RopeDynamics(vehicle, [rope])
        body = np.concatenate((scene.pos_w, scene.quat_wb, scene.vel_w, scene.rate_b))
        self._state = np.concatenate(
            (body, scene.cable_dir_w().ravel(), scene.cable_vel_w().ravel())
        )[None]

    def _rates(
        self, state: np.ndarray, _time: float, force_b: np.ndarray, torque_b: np.ndarray
    ) -> np.ndarray:
        body, size = state[:, :13], 3 * self.scene.segments
        rotation = rotation_from_quat(body[:, 3:7])
        n, n_dot = (
            state[:, 13 : 13 + size].reshape(1, -1, 3),
            state[:, 13 + size :].reshape(1, -1, 3),
        )
        wrench = (turned(rotation, force_b[None]), torque_b[None])
        rope = (n, n_dot, np.zeros(1), np.zeros(1))
        acc, second, _ = self._ropes.attached(
            np.arange(1), body, rotation, wrench, rope, np.zeros((1, 3))
        )
        parts = (
            body[:, 7:10],
            quat_dot(body[:, 3:7], body[:, 10:13]),
            acc,
            n_dot.reshape(1, -1),
            second.reshape(1, -1),
        )
        return np.hstack(parts)

    def advance(self, time: float) -> None:
        """Integrate to ``time`` [s]."""
        switches = [w.t_start for w in self.scene.schedule if self.time < w.t_start < time]
        for stop in [*switches, time]:
            wrench = wrench_at(self.scene, self.time)
            force_b, torque_b = np.array(wrench.force_b, float), np.array(wrench.torque_b, float)
            count = int(np.ceil((stop - self.time) / self.step_size - 1e-6))
            step = np.full(1, (stop - self.time) / count)
            size = 3 * self.scene.segments
            rope = slice(13, 13 + size), slice(13 + size, 13 + 2 * size)
            rates = functools.partial(self._rates, force_b=force_b, torque_b=torque_b)
            for _ in range(count):
                self._state = halving_rk4(rates, self._state, step, *rope)
                self._state[:, 3:7] /= np.linalg.norm(self._state[:, 3:7])
            self.time = stop

    @property
    def body(self) -> np.ndarray:
        """Position, quaternion xyzw, velocity, body rate, shape (13,)."""
        return self._state[0, :13].copy()

    @property
    def rope(self) -> tuple[np.ndarray, np.ndarray]:
        """Directions and their time derivatives [1/s], shapes (L, 3)."""
        size = 3 * self.scene.segments
        return (
            self._state[0, 13 : 13 + size].reshape(-1, 3).copy(),
            self._state[0, 13 + size :].reshape(-1, 3).copy(),
        )

    @property
    def ball(self) -> tuple[np.ndarray, np.ndarray]:
        """Position [m] and velocity [m/s] of the ball, world frame."""
        body = self._state[:, :13]
        rotation = rotation_from_quat(body[:, 3:7])
        mount = self._ropes.mount
        pos = body[:, :3] + turned(rotation, mount)
        vel = body[:, 7:10] + turned(rotation, cross(body[:, 10:13], mount))
        n, n_dot = self.rope
        _, ball, ball_vel = self._ropes.points(
            pos, vel, (n[None], n_dot[None], np.zeros(1), np.zeros(1))
        )
        return ball[0], ball_vel[0]
