"""Parts of :class:`ThrowEnv`, an option of the task each: delayed poses, a detector's view, moving
goals, a fleet.

A part holds in ``buffers`` what an episode carries from step to step, and draws in ``begin`` what
stays fixed over an episode. The order in which parts draw is fixed: a seed gives the same bits."""

import math
from collections.abc import Mapping

import torch
from torch import Tensor

from camera import arrays
from camera.keypoint_noise import StepDraw, apply_latency, apply_noise
from camera.keypoints import KEYPOINTS, KeypointCamera, corrected_keypoints, keypoints
from camera.params import CameraParams
from visthrow.onboard import observations as ob
from visthrow.task import ObservationParams, TaskParams
from visthrow.task.fleet import Member

POSE = ob.VEHICLE + 3
"""Width of a pose sample: the vehicle's part of a frame and the payload's position."""


def redraw(buffers: Mapping[str, Tensor], spreads: Mapping[str, float], fresh: Tensor) -> None:
    """Draw each buffer anew where an episode begins, with its deviation; 0 leaves it as it is."""
    for name, std in spreads.items():
        if std > 0.0:
            old = buffers[name]
            trailing = (1,) * (old.dim() - 1)
            mask = fresh.view(-1, *trailing)
            torch.where(mask, torch.randn_like(old) * std, old, out=old)


class FleetSetup:
    """The set-up of each environment's vehicle, in the units of its vehicle, shape (E, ...)."""

    def __init__(self, fleet: list[Member], task: TaskParams, member: Tensor):
        """Gather the set-ups; ``member``: index of each environment's vehicle, shape (E,)."""

        def gather(values: list) -> Tensor:
            return torch.tensor(values, device=member.device, dtype=torch.float32)[member]

        self.max_thrust = gather([[m.max_thrust] for m in fleet])
        self.start_action = gather([m.first_action for m in fleet])
        self.observed = gather([m.setup(task.observation.setup) for m in fleet])
        self.exact = gather([m.exact for m in fleet])
        self.time_unit = gather([m.units.time for m in fleet])  # [s]
        self.payload_radius = gather([m.plant.rope.payload_radius for m in fleet])


class PoseDelay:
    """A delay line of poses: what is measured is as old as its episode's latency."""

    def __init__(self, params: ObservationParams, period: float, like: Tensor, unit: Tensor | None):
        """Allocate.

        Args:
            params: latency and its jitter. period: of control [s].
            like: shape (E, ...), gives count and device.
            unit: of each environment's time [s], shape (E,), in which latencies are stated; None
                for seconds.
        """
        self._params = params
        self._period = period
        self._unit = torch.ones_like(like[:1]) if unit is None else unit
        oldest = params.oldest / float(self._unit.min())
        steps = 1 + max(math.ceil(oldest / period - 1e-6), 1)
        self.age = like.new_zeros(len(like))  # of what is measured in these episodes [s]
        self.poses = like.new_zeros(len(like), steps, POSE)
        self.buffers = {"pose_age": self.age, "poses": self.poses}

    def begin(self, fresh: Tensor) -> None:
        """Draw the latency of the episodes that begin."""
        low, high = self._params.latency
        if high == 0.0:
            return
        sample = low + (high - low) * torch.rand_like(self.age)
        torch.where(fresh, sample / self._unit, self.age, out=self.age)

    def push(self, pose: Tensor, fresh: Tensor) -> Tensor:
        """Take the current pose sample; return the delayed one, linear between control steps."""
        self.poses.copy_(arrays.push(self.poses, pose, fresh))
        if self._params.oldest == 0.0:
            return pose
        age = self.age
        jitter = self._params.latency_jitter
        if jitter > 0.0:
            sample = 2.0 * torch.rand_like(age) - 1.0
            age = age + jitter * sample / self._unit
        age = age / self._period
        whole = age.floor().clamp(max=self.poses.shape[1] - 2.0)
        row = whole.long()[:, None, None].expand(-1, 1, POSE)
        newer = self.poses.gather(1, row)[:, 0]
        older = self.poses.gather(1, row + 1)[:, 0]
        return newer + (older - newer) * (age - whole)[:, None]

    def exact(self, age: float) -> Tensor:
        """Pose sample of so long ago [s], at most a control period, shape (E, POSE)."""
        return torch.lerp(self.poses[:, 0], self.poses[:, 1], age / self._period)


class MovingGoals:
    """Goals that move at a constant velocity, drawn for each episode."""

    def __init__(self, speed: tuple[float, float], like: Tensor):
        """Allocate; ``speed``: slowest and fastest [m/s]. like: shape (E, ...)."""
        self._slowest, self._fastest = speed
        self.velocity = like.new_zeros(len(like), 3)  # [m/s], world frame
        self.buffers = {"goal_vel": self.velocity}

    def begin(self, fresh: Tensor) -> None:
        """Draw speed and heading of the episodes that begin."""
        sample = torch.rand_like(self.velocity[:, :2])
        speed = self._slowest + (self._fastest - self._slowest) * sample[:, 0]
        heading = 2.0 * math.pi * sample[:, 1]
        x = speed * heading.cos()
        y = speed * heading.sin()
        new = torch.stack([x, y, torch.zeros_like(x)], dim=-1)
        self.velocity.copy_(torch.where(fresh[:, None], new, self.velocity))


class DetectorView:
    """Keypoints as a detector reports them: mount and focal-length errors, latency, noise,
    drop-outs and repeated images.
    """

    def __init__(self, params: CameraParams, like: Tensor):
        """Allocate; ``like``: shape (E, ...), gives count and device."""
        self._params = params
        self.camera = KeypointCamera(params, str(like.device))
        self.correction: tuple[Tensor, Tensor] | None = None
        """Turns of the cameras [rad], shape (E, 3), and errors of their focal lengths [-], shape
        (E,), that a calibration estimated."""
        E = len(like)
        depth = params.noise.history_length
        self._latency = like.new_tensor(params.noise.latency)
        self.buffers = {
            "keypoint_bias": like.new_zeros(E, KEYPOINTS, 2),
            "extrinsic_rotation": like.new_zeros(E, 3),
            "extrinsic_offset": like.new_zeros(E, 3),
            "scale_error": like.new_zeros(E, 1, 1),
            "held_points": like.new_zeros(E, KEYPOINTS, 2),
            "held_valid": like.new_zeros(E, KEYPOINTS, dtype=torch.bool),
            "late_points": like.new_zeros(E, depth, KEYPOINTS, 2),
            "late_valid": like.new_zeros(E, depth, KEYPOINTS, dtype=torch.bool),
        }

    def begin(self, fresh: Tensor) -> None:
        """Draw the errors of the episodes that begin."""
        noise = self._params.noise
        mount = self._params.mount
        spreads = {
            "keypoint_bias": noise.bias_std,
            "extrinsic_rotation": mount.rotation_error_std,
            "extrinsic_offset": mount.position_error_std,
            "scale_error": noise.scale_std,
        }
        redraw(self.buffers, spreads, fresh)

    def _extrinsics(self) -> tuple[Tensor, Tensor] | None:
        """Return the mounts of these episodes' cameras; None where all are nominal."""
        mount = self._params.mount
        if mount.rotation_error_std == 0.0 and mount.position_error_std == 0.0:
            return None
        rotation = self.buffers["extrinsic_rotation"]
        offset = self.buffers["extrinsic_offset"]
        return self.camera.extrinsics(rotation, offset)

    def look(
        self, pos_w: Tensor, rot_wb: Tensor, goal_w: Tensor, payload_w: Tensor, fresh: Tensor
    ) -> tuple[Tensor, Tensor]:
        """Return keypoints [-], shape (E, K, 2), and validity, shape (E, K)."""
        buffers = self.buffers
        noise = self._params.noise
        mounts = self._extrinsics()
        points, valid = keypoints(self.camera, pos_w, rot_wb, goal_w, payload_w, mounts)
        if noise.seen_radius < 1.0:
            distance = points.square().sum(-1)
            valid = valid & (distance <= noise.seen_radius**2)
        if noise.scale_std > 0.0:
            points = points * (1.0 + buffers["scale_error"])
        if noise.latency > 0.0:
            late_points = buffers["late_points"]
            late_valid = buffers["late_valid"]
            late_points.copy_(arrays.push(late_points, points, fresh))
            late_valid.copy_(arrays.push(late_valid, valid, fresh))
            points, valid = apply_latency(late_points, late_valid, self._latency)
        normals = torch.randn_like(points)
        uniforms = torch.rand_like(points[..., 0])
        draw = StepDraw(normals, uniforms)
        if noise.wrong_probability > 0.0:
            wrong = torch.rand(*points.shape[:2], 3, device=points.device)
            draw = draw._replace(wrong=wrong)
        points, valid = apply_noise(noise, points, valid, buffers["keypoint_bias"], draw)
        if noise.held_probability > 0.0:
            share = torch.rand_like(points[:, 0, 0])
            repeated = (share < noise.held_probability) & ~fresh
            points = torch.where(repeated[:, None, None], buffers["held_points"], points)
            valid = torch.where(repeated[:, None], buffers["held_valid"], valid)
            buffers["held_points"].copy_(points)
            buffers["held_valid"].copy_(valid)
        if self.correction is None:
            return points, valid
        return corrected_keypoints(self.camera, points, valid, *self.correction)
