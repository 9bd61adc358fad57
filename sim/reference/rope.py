"""Accelerations of quadrotors with ropes, and of loose ropes, computed by MuJoCo C.

The rope's state consists of the direction of every segment and its time derivative. In each
evaluation these are converted to MuJoCo's ball joints without axial spin. No force drives a slender
rod about its axis, so its spin stays zero and the state needs no angle that could be singular.
MuJoCo's angular accelerations are converted back.

Joint damping is applied as couples ``-d (w_i - w_(i-1))`` between neighbours. Only the part
perpendicular to a rod's axis acts on the rod."""

import numpy as np
from numpy import ndarray

from sim.params import BodyParams, RopeParams
from sim.reference.batch import Batch
from sim.reference.model import build_attached, build_free
from sim.reference.rotation_arrays import (
    cross,
    length,
    quat_wxyz_from_matrix,
    rotate,
    rotate_back,
    rotation_from_direction,
)

RopeState = tuple[ndarray, ...]
"""Directions of the segments and their derivatives, shapes (e, L, 3), elongation [m] and its rate,
shapes (e,).
"""
Motion = tuple[ndarray, ndarray, ndarray]
"""Three quantities of a motion, as the docstrings of the functions define them."""


class RopeDynamics:
    """Ropes of E environments, each with its own masses and lengths.

    Args:
        body: of all vehicles.
        ropes: one for each environment, all with the same number of segments.
        stretch: stiffness [N/m] and damping [N s/m] between last segment and payload, or None.
        mount_damping: additional damping of the joint at the mount while attached [N m s].
    """

    def __init__(
        self,
        body: BodyParams,
        ropes: list[RopeParams],
        stretch: tuple[float, float] | None,
        mount_damping: float,
    ):
        self.segments = ropes[0].segments
        self.count = len(ropes)
        self.stretch = stretch
        self.length = np.array([rope.segment_length for rope in ropes])
        self.offset = np.array([rope.payload_offset for rope in ropes])
        self.mount = np.array([rope.mount for rope in ropes])
        self.damping = np.array([rope.joint_damping for rope in ropes])
        self.mount_damping = mount_damping
        attached = [build_attached(body, rope, "ball", stretch=stretch) for rope in ropes]
        self._attached = _bound_batch(attached)
        self._free = _bound_batch([build_free(rope, stretch=stretch) for rope in ropes])
        # Forces on the payload act on the last body: with stretch the payload itself, else the last
        # rod, with an arm.
        self._centre = np.array([-model.body_ipos[-1, 2] for model in attached])

    def accelerate_attached(
        self,
        ids: ndarray,
        body: ndarray,
        rotation: ndarray,
        wrench: tuple[ndarray, ndarray],
        rope: RopeState,
        force_w: ndarray,
    ) -> Motion:
        """Return the accelerations of quadrotors with their ropes.

        Args:
            ids: environments, shape (e,); all other arguments have rows only for these.
            body: columns of ``quadrotor.BODY``, shape (e, 13).
            rotation: rot_wb, shape (e, 3, 3).
            wrench: force [N], world frame, and torque [N m], body frame, about the quadrotor's
                centre of mass, shapes (e, 3).
            force_w: on the payload's centre [N], shape (e, 3).

        Returns:
            Acceleration [m/s^2], world frame, and angular acceleration [rad/s^2], body frame,
            shape (e, 6); second derivatives of directions [1/s^2], shape (e, L, 3), and elongation
            [m/s^2], shape (e,).
        """
        pose = np.hstack((body[:, :3], body[:, [6, 3, 4, 5]] / length(body[:, 3:7])))
        wrench_w = np.hstack((wrench[0], rotate(rotation, wrench[1])))
        above = (rotation, rotate(rotation, body[:, 10:13]), wrench_w)
        upper_damping = self.damping[ids] + self.mount_damping
        root = (pose, body[:, 7:13])
        return self._solve(self._attached, ids, root, above, upper_damping, rope, force_w)

    def accelerate_free(
        self,
        ids: ndarray,
        root: tuple[ndarray, ndarray],
        rope: RopeState,
        force_w: ndarray,
    ) -> Motion:
        """Return the accelerations of loose ropes: of the upper end, of the directions and of the
        elongation.

        Args:
            ids: environments, shape (e,); all other arguments have rows only for these.
            root: position [m] and velocity [m/s] of the upper end, world frame, shapes (e, 3).
            force_w: on the payload's centre [N], shape (e, 3).
        """
        count = len(ids)
        world = (np.tile(np.eye(3), (count, 1, 1)), np.zeros((count, 3)), np.zeros((count, 6)))
        return self._solve(self._free, ids, root, world, np.zeros(count), rope, force_w)

    def _solve(
        self,
        bound: tuple,
        ids: ndarray,
        root: tuple[ndarray, ndarray],
        above: Motion,
        upper_damping: ndarray,
        rope: RopeState,
        force_w: ndarray,
    ) -> Motion:
        """Return the accelerations of root, directions and elongation from a batch of models.

        Args:
            bound: of :func:`_bound_batch`.
            ids: environments.
            root: MuJoCo's coordinates and velocities above the rods.
            above: rotation, angular velocity and wrench of the body above the first rod, world
                frame. If this body is the world, MuJoCo ignores the wrench.
            upper_damping: of the first joint [N m s], shape (e,).
            force_w: on the payload's centre [N], shape (e, 3).
        """
        batch, positions, velocities, wrenches, accelerations = bound
        rotation, rate_above, wrench_w = above
        n = rope[0] / length(rope[0])
        rates = cross(n, rope[1])
        frames = rotation_from_direction(n)
        relative = rates - np.concatenate((rate_above[:, None], rates[:, :-1]), 1)
        local = rotate_back(frames, relative)
        parents = np.concatenate((rotation[:, None], frames[:, :-1]), 1)
        joints = quat_wxyz_from_matrix(np.swapaxes(parents, -1, -2) @ frames)
        couples = self._couples(ids, upper_damping, relative)
        applied = np.zeros((len(ids), *wrenches.shape[1:]))
        elongations = [] if self.stretch is None else [part[:, None] for part in rope[2:]]
        first = applied.shape[1] - self.segments - bool(elongations)
        applied[:, first - 1] = wrench_w
        applied[:, first - 1, 3:] -= couples[:, 0]
        couples[:, :-1] -= couples[:, 1:].copy()
        couples -= np.sum(couples * n, -1, keepdims=True) * n
        applied[:, first : first + self.segments, 3:] = couples
        applied[:, -1, :3] = force_w
        if self.stretch is None:
            arm = (self.length + self.offset)[ids] - self._centre[ids]
            applied[:, -1, 3:] += arm[:, None] * cross(n[:, -1], force_w)
        rows = len(ids), -1
        positions[ids] = np.hstack((root[0], joints.reshape(rows), *elongations[:1]))
        velocities[ids] = np.hstack((root[1], local.reshape(rows), *elongations[1:]))
        wrenches[ids] = applied
        batch.forward(ids if len(ids) < self.count else None)
        qacc = accelerations[ids]
        head = root[1].shape[1]
        rod_acc = qacc[:, head : head + 3 * self.segments].reshape(local.shape)
        turning = rotate(frames, rod_acc) + cross(rates, rotate(frames, local))
        alpha = np.cumsum(turning, axis=1)
        if head == 6:
            alpha += rotate(rotation, qacc[:, 3:6])[:, None]
        second = cross(alpha, n) + cross(rates, cross(rates, n))
        elongation = qacc[:, -1] if elongations else np.zeros(len(ids))
        return qacc[:, :head], second, elongation

    def _couples(self, ids: ndarray, upper_damping: ndarray, relative: ndarray) -> ndarray:
        """Return the damping torque of each joint on the rod below it [N m], shape (e, L, 3), from
        the rods' rates relative to the bodies above them [rad/s].
        """
        damping = np.tile(self.damping[ids, None], self.segments)
        damping[:, 0] = upper_damping
        return -damping[..., None] * relative

    def points(self, root_pos: ndarray, root_vel: ndarray, rope: RopeState) -> Motion:
        """Return upper end, joints and lower end of the rope [m], shape (E, L + 1, 3), and position
        and velocity of the payload.

        Args:
            root_pos: upper end [m], shape (E, 3).
            root_vel: its velocity [m/s], shape (E, 3).
        """
        n, _, elongation, _ = rope
        root = root_pos[:, None]
        steps = np.cumsum(self.length[:, None, None] * n, axis=1)
        points = np.concatenate((root, root + steps), 1)
        pos = points[:, -1] + (self.offset + elongation)[:, None] * n[:, -1]
        return points, pos, self.payload_velocity(root_vel, rope)

    def payload_velocity(self, root_vel: ndarray, rope: RopeState) -> ndarray:
        """Return the velocity of the payload's centre [m/s], world frame, shape (E, 3); arguments
        as of :meth:`points`.
        """
        n, n_dot, elongation, elongation_dot = rope
        below = (self.offset + elongation)[:, None]
        turning = self.length[:, None] * n_dot.sum(axis=1) + below * n_dot[:, -1]
        return root_vel + turning + elongation_dot[:, None] * n[:, -1]


def _bound_batch(models: list) -> tuple:
    """Return a batch of models with its arrays of coordinates, velocities, wrenches and
    accelerations. Each call of ``forward`` overwrites the accelerations.
    """
    batch = Batch(models[0], len(models), nthread=1)
    batch.set_models(models)
    names = ("qpos", "qvel", "xfrc_applied", "qacc")
    return batch, *[batch.bind(name) for name in names]
