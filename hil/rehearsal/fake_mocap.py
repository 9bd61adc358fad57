"""A model of a motion-capture system: rate, noise, latency and loss, from a seed.

The fake autopilot sends these poses over the link; with the same seed, a throw flown directly in
the simulator gets the same poses."""

import math
from dataclasses import dataclass
from typing import Annotated, Any

import numpy as np

from hil.poses.pose import PAYLOAD, VEHICLE, Pose
from visthrow.common.mocap import add_mocap_noise
from visthrow.config.bounds import Bound, Bounded, NotNegative, Positive

SLACK = 1e-9  # tolerance of times that are sums of periods [s]


@dataclass(frozen=True)
class FakeMocapParams(Bounded):
    """Parameters of the motion capture."""

    rate: Positive = 100.0  # poses a second of each body [Hz]
    position_noise: NotNegative = 1e-3  # standard deviation [m]
    angle_noise_deg: NotNegative = 0.2  # standard deviation about each axis
    latency: NotNegative = 0.01  # from the instant of a pose to its sending [s]
    loss: Annotated[float, Bound(0.0, 1.0, "[)")] = 0.02  # share of poses that are lost


class Mocap:
    """A motion-capture system that measures vehicle and payload."""

    def __init__(self, params: FakeMocapParams, seed: int):
        """Start with a measurement at time 0; ``seed``: of noise and loss."""
        self.params = params
        self._rng = np.random.default_rng(seed)
        self._next = 0.0

    def due(self, time: float) -> bool:
        """Return whether a measurement is due at a time [s]."""
        return time >= self._next - SLACK

    def measure(self, time: float, truth: dict[str, Any]) -> list[Pose]:
        """Measure both bodies at this time [s], which is the due one, of their true ``pos_w``,
        ``quat_wb`` and ``payload_pos_w``.

        Return the poses that are not lost, vehicle first, in our frames; they arrive after the
        latency."""
        self._next += 1.0 / self.params.rate
        p = self.params
        rng = self._rng
        noise = {
            "pos_w": p.position_noise,
            "payload_pos_w": p.position_noise,
            "quat_wb": math.radians(p.angle_noise_deg),
        }
        exact = {name: truth[name][None].astype(float) for name in noise}
        vehicle, payload, quat = add_mocap_noise(exact, noise, rng).values()
        lost = rng.random(2) < p.loss
        bodies = ((VEHICLE, vehicle, quat[0].tolist()), (PAYLOAD, payload, (0.0, 0.0, 0.0, 1.0)))
        poses = [
            Pose(time, time + p.latency, body, tuple(pos[0].tolist()), tuple(attitude))
            for body, pos, attitude in bodies
        ]
        return [pose for pose, is_lost in zip(poses, lost) if not is_lost]
