"""Optional parts of :class:`ThrowEnv`: delayed poses, moving goals and a fleet of vehicles.

``buffers`` holds a part's state from step to step. ``begin`` draws the quantities that are constant
over an episode. The parts draw in a fixed order, so that a seed always gives the same bits."""

import math

import torch
from torch import Tensor

from camera import arrays
from visthrow.onboard import observations as ob
from visthrow.task import ObservationParams, TaskParams
from visthrow.task.fleet import Member

POSE = ob.VEHICLE + 3
"""Width of a pose sample: the vehicle's part of a frame and the payload's position."""


class FleetSetup:
    """Properties of each environment's vehicle, in that vehicle's units, shape (E, ...)."""

    def __init__(self, fleet: list[Member], task: TaskParams, member: Tensor):
        """Gather the properties; ``member``: index of each environment's vehicle, shape (E,)."""

        def gather(values: list) -> Tensor:
            return torch.tensor(values, device=member.device, dtype=torch.float32)[member]

        self.max_thrust = gather([[m.max_thrust] for m in fleet])
        self.start_action = gather([m.first_action for m in fleet])
        self.observed = gather([m.setup(task.observation.setup) for m in fleet])
        self.exact = gather([m.exact for m in fleet])
        self.time_unit = gather([m.units.time for m in fleet])  # [s]
        self.payload_radius = gather([m.plant.rope.payload_radius for m in fleet])


class PoseDelay:
    """A delay line that makes measured poses as old as the latency of their episode."""

    def __init__(self, params: ObservationParams, period: float, like: Tensor, unit: Tensor | None):
        """Allocate the delay line.

        Args:
            params: latency and its jitter. period: control period [s].
            like: tensor of shape (E, ...) that determines the count and the device.
            unit: unit of time in which each environment's latencies are stated [s], shape (E,);
                None for seconds.
        """
        self._params = params
        self._period = period
        self._unit = torch.ones_like(like[:1]) if unit is None else unit
        oldest = params.oldest / float(self._unit.min())
        steps = 1 + max(math.ceil(oldest / period - 1e-6), 1)
        self.age = like.new_zeros(len(like))  # age of measured poses in each episode [s]
        self.poses = like.new_zeros(len(like), steps, POSE)
        self.buffers = {"pose_age": self.age, "poses": self.poses}

    def begin(self, fresh: Tensor) -> None:
        """Draw latencies for the episodes that begin; ``fresh``: bool, shape (E,)."""
        low, high = self._params.latency
        if high == 0.0:
            return
        sample = low + (high - low) * torch.rand_like(self.age)
        torch.where(fresh, sample / self._unit, self.age, out=self.age)

    def push(self, pose: Tensor, fresh: Tensor) -> Tensor:
        """Store the current pose sample and return the delayed one, interpolated linearly between
        control steps.
        """
        poses = self.poses
        poses.copy_(arrays.push(poses, pose, fresh))
        if self._params.oldest == 0.0:
            return pose
        age = self.age
        jitter = self._params.latency_jitter
        if jitter > 0.0:
            sample = 2.0 * torch.rand_like(age) - 1.0
            age = age + jitter * sample / self._unit
        age = age / self._period
        whole = age.floor().clamp(max=poses.shape[1] - 2.0)
        row = whole.long()[:, None, None].expand(-1, 1, POSE)
        newer = poses.gather(1, row)[:, 0]
        older = poses.gather(1, row + 1)[:, 0]
        return newer + (older - newer) * (age - whole)[:, None]

    def exact(self, age: float) -> Tensor:
        """Return the pose sample of an age [s] of at most a control period, shape (E, POSE)."""
        return torch.lerp(self.poses[:, 0], self.poses[:, 1], age / self._period)


class MovingGoals:
    """Goals that move at a constant velocity, drawn for each episode."""

    def __init__(self, speed: tuple[float, float], like: Tensor):
        """Allocate; ``speed``: lowest and highest [m/s]; ``like``: tensor of shape (E, ...)."""
        self._slowest, self._fastest = speed
        self.velocity = like.new_zeros(len(like), 3)  # [m/s], world frame
        self.buffers = {"goal_vel": self.velocity}

    def begin(self, fresh: Tensor) -> None:
        """Draw goal velocities for the episodes that begin; ``fresh``: bool, shape (E,)."""
        sample = torch.rand_like(self.velocity[:, :2])
        speed = self._slowest + (self._fastest - self._slowest) * sample[:, 0]
        heading = 2.0 * math.pi * sample[:, 1]
        x = speed * heading.cos()
        y = speed * heading.sin()
        new = torch.stack([x, y, torch.zeros_like(x)], dim=-1)
        self.velocity.copy_(torch.where(fresh[:, None], new, self.velocity))
