"""Accelerations of quadrotors with ropes, and of ropes alone, from MuJoCo C.

The rope's state is the direction of every segment and its time derivative. In each evaluation
MuJoCo is given ball joints that stand for these directions, without any axial spin: nothing drives
a slender rod about its axis, so its spin stays zero, and the state holds no angle that could be
singular. What comes back are angular accelerations.

Joint damping is applied as couples ``-d (w_i - w_(i-1))`` between neighbours. A rod takes the part
across its axis."""

import numpy as np

from sim.params import BodyParams, RopeParams
from sim.reference.batch import Batch
from sim.reference.model import build_attached, build_free
from sim.reference.rotation_arrays import (
    cross,
    length,
    quat_wxyz_from_matrix,
    rotation_from_direction,
    turned,
    turned_back,
)


class RopeDynamics:
    """Ropes of E environments, each with its own masses and lengths.

    Raises ValueError: different numbers of segments.

    Args:
        body: of all vehicles.
        ropes: one an environment, all with the same number of segments.
        stretch: stiffness [N/m] and damping [N s/m] between last segment and payload, or None.
        mount_damping: of the uppermost joint besides the ropes' own while it is on the vehicle [N m
            s].
    """

    def __init__(
        self,
        body: BodyParams,
        ropes: list[RopeParams],
        stretch: tuple[float, float] | None = None,
        mount_damping: float = 0.0,
    ) -> None:
        self.segments = ropes[0].segments
        if any(rope.segments != self.segments for rope in ropes):
            raise ValueError(
                f"ropes have {sorted({rope.segments for rope in ropes})} segments, expected one"
                " number"
            )
        self.count = len(ropes)
        self.stretch = stretch
        self.length = np.array([rope.segment_length for rope in ropes])
        self.offset = np.array([rope.payload_offset for rope in ropes])
        self.mount = np.array([rope.mount for rope in ropes])
        self.damping = np.array([rope.joint_damping for rope in ropes])
        self.mount_damping = mount_damping
        self._attached_models = [
            build_attached(body, rope, "ball", stretch=stretch) for rope in ropes
        ]
        self._free_models = [build_free(rope, stretch=stretch) for rope in ropes]
        self._attached = Batch(self._attached_models[0], self.count, nthread=1)
        self._attached.set_models(self._attached_models)
        self._free = Batch(self._free_models[0], self.count, nthread=1)
        self._free.set_models(self._free_models)
        names = "qpos", "qvel", "xfrc_applied", "qacc"  # of these qacc is copied after each call
        self._bound = {
            batch: [batch.bind(name) for name in names] for batch in (self._attached, self._free)
        }
        # The payload is the last body; with stretch it is its own, else its force acts on the last
        # rod by its arm.
        self._centre = np.array([-model.body_ipos[-1, 2] for model in self._attached_models])

    def _rod_couples(
        self, ids: np.ndarray, relative: np.ndarray, n: np.ndarray
    ) -> tuple[np.ndarray, np.ndarray]:
        """Damping couples on the rods [N m], shape (e, L, 3), and the one on the body above, shape
        (e, 3); of their relative rates.
        """
        couples = -self.damping[ids][:, None, None] * relative
        couples[:, 0] -= self.mount_damping * relative[:, 0]
        on_above = -couples[:, 0]
        couples[:, :-1] -= couples[:, 1:].copy()
        couples -= np.sum(couples * n, -1, keepdims=True) * n
        return couples, on_above

    def _applied(
        self,
        batch: Batch,
        ids: np.ndarray,
        first_rod: int,
        n: np.ndarray,
        couples: np.ndarray,
        force_w: np.ndarray,
    ) -> np.ndarray:
        """Wrenches on all bodies: damping couples on the rods and a force at the
        payload's centre.
        """
        applied = np.zeros((len(ids), *self._bound[batch][2].shape[1:]))
        applied[:, first_rod : first_rod + self.segments, 3:] = couples
        applied[:, -1, :3] = force_w
        if self.stretch is None:
            arm = (self.length + self.offset)[ids] - self._centre[ids]
            applied[:, -1, 3:] += arm[:, None] * cross(n[:, -1], force_w)
        return applied

    def _unpack(
        self,
        alpha: np.ndarray,
        frames: np.ndarray,
        qacc: np.ndarray,
        local: np.ndarray,
        rates: np.ndarray,
        n: np.ndarray,
    ) -> np.ndarray:
        """Second derivatives of the directions from relative angular accelerations, shape (e, L,
        3).
        """
        relative = turned(frames, qacc) + cross(rates, turned(frames, local))
        alpha = alpha[:, None] + np.cumsum(relative, axis=1)
        n_dot = cross(rates, n)
        return cross(alpha, n) + cross(rates, n_dot)

    def _directions(
        self, n: np.ndarray, n_dot: np.ndarray
    ) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        n = n / length(n)
        return n, cross(n, n_dot), rotation_from_direction(n)

    def attached(
        self,
        ids: np.ndarray,
        body: np.ndarray,
        rotation: np.ndarray,
        wrench: tuple[np.ndarray, np.ndarray],
        rope: tuple[np.ndarray, ...],
        force_w: np.ndarray,
    ) -> tuple[np.ndarray, np.ndarray, np.ndarray, np.ndarray]:
        """Return accelerations of quadrotors with their ropes.

        Args:
            ids: environments, shape (e,); every other argument has their rows only.
            body: columns of ``quadrotor.BODY``, shape (e, 13).
            rotation: rot_wb, shape (e, 3, 3).
            wrench: force [N], world frame, and torque [N m], body frame, about the quadrotor's
                centre of mass, shapes (e, 3).
            rope: directions and their derivatives, shapes (e, L, 3), elongation [m] and its rate,
                shapes (e,).
            force_w: on the payload's centre [N], shape (e, 3).

        Returns:
            Acceleration [m/s^2], world frame, and angular acceleration [rad/s^2], body frame,
            shapes (e, 3); second derivatives of directions [1/s^2], shape (e, L, 3), and elongation
            [m/s^2], shape (e,).
        """
        n, rates, frames = self._directions(rope[0], rope[1])
        above = turned(rotation, body[:, 10:13])
        relative_rates = _from_above(rates, above)
        couples, on_vehicle = self._rod_couples(ids, relative_rates, n)
        parents = np.concatenate((rotation[:, None], frames[:, :-1]), 1)
        local = turned_back(frames, relative_rates)
        joints = quat_wxyz_from_matrix(np.swapaxes(parents, -1, -2) @ frames).reshape(len(ids), -1)
        qpos = [body[:, 0:3], body[:, [6, 3, 4, 5]] / length(body[:, 3:7]), joints]
        qvel = [body[:, 7:13], local.reshape(len(ids), -1)]
        applied = self._applied(self._attached, ids, 2, n, couples, force_w)
        applied[:, 1, :3] = wrench[0]
        applied[:, 1, 3:] = on_vehicle + turned(rotation, wrench[1])
        qacc = self._forward(self._attached, ids, qpos, qvel, rope, applied)
        alpha = turned(rotation, qacc[:, 3:6])
        relative = qacc[:, 6 : 6 + 3 * self.segments].reshape(len(ids), -1, 3)
        second = self._unpack(alpha, frames, relative, local, rates, n)
        return qacc[:, :3], qacc[:, 3:6], second, self._elongation(qacc)

    def free(
        self,
        ids: np.ndarray,
        root: tuple[np.ndarray, np.ndarray],
        rope: tuple[np.ndarray, ...],
        force_w: np.ndarray,
    ) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """Return accelerations of ropes alone: of the upper end, of the directions and of the
        elongation.

        Args:
            ids: environments, shape (e,); every other argument has their rows only.
            root: position [m] and velocity [m/s] of the upper end, world frame, shapes (e, 3).
            rope: as in ``attached``.
            force_w: on the payload's centre [N], shape (e, 3).
        """
        n, rates, frames = self._directions(rope[0], rope[1])
        couples, _ = self._rod_couples(ids, _from_above(rates, rates[:, 0]), n)
        relative_rotation = frames.copy()
        relative_rotation[:, 1:] = np.swapaxes(frames[:, :-1], -1, -2) @ frames[:, 1:]
        local = turned_back(frames, _from_above(rates, np.zeros((len(ids), 3))))
        qpos = [root[0], quat_wxyz_from_matrix(relative_rotation).reshape(len(ids), -1)]
        qvel = [root[1], local.reshape(len(ids), -1)]
        applied = self._applied(self._free, ids, 1, n, couples, force_w)
        qacc = self._forward(self._free, ids, qpos, qvel, rope, applied)
        relative = qacc[:, 3 : 3 + 3 * self.segments].reshape(len(ids), -1, 3)
        second = self._unpack(np.zeros((len(ids), 3)), frames, relative, local, rates, n)
        return qacc[:, :3], second, self._elongation(qacc)

    def _elongation(self, qacc: np.ndarray) -> np.ndarray:
        return np.zeros(len(qacc)) if self.stretch is None else qacc[:, -1]

    def _forward(
        self,
        batch: Batch,
        ids: np.ndarray,
        qpos: list[np.ndarray],
        qvel: list[np.ndarray],
        rope: tuple[np.ndarray, ...],
        applied: np.ndarray,
    ) -> np.ndarray:
        if self.stretch is not None:
            qpos = [*qpos, rope[2][:, None]]
            qvel = [*qvel, rope[3][:, None]]
        positions, velocities, wrenches, accelerations = self._bound[batch]
        positions[ids] = np.concatenate(qpos, 1)
        velocities[ids] = np.concatenate(qvel, 1)
        wrenches[ids] = applied
        batch.forward(ids if len(ids) < self.count else None)
        return accelerations[ids]

    def points(
        self, root_pos: np.ndarray, root_vel: np.ndarray, rope: tuple[np.ndarray, ...]
    ) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """Return mount, joints and end of the rope [m], shape (E, L+1, 3), and position and
        velocity of the payload.

        Args:
            root_pos: upper end [m], shape (E, 3).
            root_vel: its velocity [m/s], shape (E, 3).
            rope: as in ``attached``.
        """
        n, _, elongation, _ = rope
        root = root_pos[:, None]
        steps = np.cumsum(self.length[:, None, None] * n, axis=1)
        points = np.concatenate((root, root + steps), 1)
        pos = points[:, -1] + (self.offset + elongation)[:, None] * n[:, -1]
        return points, pos, self.payload_velocity(root_vel, rope)

    def payload_velocity(self, root_vel: np.ndarray, rope: tuple[np.ndarray, ...]) -> np.ndarray:
        """Return the velocity of the payload's centre [m/s], world frame, shape (E, 3); arguments
        as of :meth:`points`.
        """
        n, n_dot, elongation, elongation_dot = rope
        below = (self.offset + elongation)[:, None]
        turning = self.length[:, None] * n_dot.sum(axis=1) + below * n_dot[:, -1]
        return root_vel + turning + elongation_dot[:, None] * n[:, -1]


def _from_above(rates: np.ndarray, above: np.ndarray) -> np.ndarray:
    """Rates of the rods less those of what they hang on, shape (e, L, 3)."""
    relative = rates.copy()
    relative[:, 0] -= above
    relative[:, 1:] -= rates[:, :-1]
    return relative
