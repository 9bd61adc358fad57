"""What a motion-capture system makes of the truth: rate, noise, latency and loss, from a seed.

The fake autopilot sends these poses over the wire; the same seed gives a throw flown in the simulator directly the same ones. What
goes wrong with it begins at a stated time, is drawn from a seed as well, and is put into poses as the source writes them.
"""

import math
from collections.abc import Callable
from dataclasses import dataclass, replace
from typing import Annotated, Any

import numpy as np

from hil.errors import RunError
from hil.poses.pose import PAYLOAD, VEHICLE, Pose
from visthrow.common.errors import suggest
from visthrow.common.mocap import measured
from visthrow.config.bounds import Bound, Bounded, NotNegative, Positive

SLACK = 1e-9  # tolerance of times that are sums of periods [s]
RARE = 0.2  # between two poses at 5 Hz [s]
JUMP = 0.5  # [m]
STEP = 1.0  # jump of a clock [s]
SHUFFLE = 0.03  # longest further delay of a pose that may be overtaken [s]


@dataclass(frozen=True)
class MocapParams(Bounded):
    """What the motion capture makes of the truth."""

    rate: Positive = 100.0  # poses a second of each body [Hz]
    position_noise: NotNegative = 1e-3  # standard deviation [m]
    angle_noise_deg: NotNegative = 0.2  # standard deviation about each axis
    latency: NotNegative = 0.01  # from the instant of a pose to its sending [s]
    loss: Annotated[float, Bound(0.0, 1.0, "[)")] = 0.02  # share of poses that never come


class Mocap:
    """Measures vehicle and payload."""

    def __init__(self, params: MocapParams, seed: int = 0) -> None:
        """Begin with a measurement at time 0; ``seed``: of noise and loss."""
        self.params = params
        self._rng = np.random.default_rng(seed)
        self._next = 0.0

    def due(self, time: float) -> bool:
        """Return whether a measurement is due at a time [s]."""
        return time >= self._next - SLACK

    def measure(self, time: float, truth: dict[str, Any]) -> list[Pose]:
        """Measure both bodies at this time [s], which is the due one, of their true ``pos_w``, ``quat_wb`` and ``payload_pos_w``.

        Those that are not lost come back, vehicle first, in our frames; their arrival is the latency after the instant.
        """
        self._next += 1.0 / self.params.rate
        p, rng = self.params, self._rng
        names = ("pos_w", "payload_pos_w", "quat_wb")
        noise = dict(zip(names, (p.position_noise, p.position_noise, math.radians(p.angle_noise_deg))))
        vehicle, payload, quat = measured({name: truth[name][None].astype(float) for name in names}, noise, rng).values()
        lost = rng.random(2) < p.loss
        seen = ((VEHICLE, vehicle, quat[0].tolist()), (PAYLOAD, payload, (0.0, 0.0, 0.0, 1.0)))
        poses = [Pose(time, time + p.latency, body, tuple(pos[0].tolist()), tuple(attitude)) for body, pos, attitude in seen]
        return [pose for pose, gone in zip(poses, lost) if not gone]


Spoil = Callable[[list[Pose], "MocapFault"], list[Pose]]


def _each(change: Callable[[Pose], dict[str, Any]]) -> Spoil:
    return lambda poses, fault: [replace(p, **change(p)) for p in poses]


def _repeat(poses: list[Pose], fault: "MocapFault") -> list[Pose]:
    return [replace(fault.last.get(p.body, p), stamp=p.stamp, arrival=p.arrival) for p in poses]


def _rare(poses: list[Pose], fault: "MocapFault") -> list[Pose]:
    kept = [p for p in poses if p.stamp - fault.kept.get(p.body, -math.inf) >= RARE - 1e-6]
    fault.kept.update({p.body: p.stamp for p in kept})
    return kept


def _shuffle(poses: list[Pose], fault: "MocapFault") -> list[Pose]:
    return [replace(p, arrival=p.arrival + SHUFFLE * float(fault.rng.random())) for p in poses]


FAULTS: dict[str, tuple[str, Spoil]] = {
    "none": ("nothing goes wrong", lambda poses, fault: poses),
    "stop": ("motion capture stops", lambda poses, fault: []),
    "repeat": ("the last pose is repeated", _repeat),
    "payload-lost": ("the payload is lost, the vehicle is not", lambda poses, fault: [p for p in poses if p.body != PAYLOAD]),
    "swap": ("vehicle and payload are exchanged", _each(lambda p: {"body": {VEHICLE: PAYLOAD, PAYLOAD: VEHICLE}[p.body]})),
    "jump": ("both bodies jump by 0.5 m", _each(lambda p: {"pos": (p.pos[0] + JUMP, *p.pos[1:])})),
    "order": ("quaternions written x, y, z, w for w, x, y, z", _each(lambda p: {"quat": (*p.quat[1:], p.quat[0])})),
    "zero-quaternion": ("quaternions of four zeros", _each(lambda p: {"quat": (0.0,) * 4})),
    "nan-quaternion": ("quaternions that are no numbers", _each(lambda p: {"quat": (math.nan,) * 4})),
    "clock-forth": ("the source's clock jumps a second ahead", _each(lambda p: {"stamp": p.stamp + STEP})),
    "clock-back": ("the source's clock jumps a second back", _each(lambda p: {"stamp": p.stamp - STEP})),
    "reset": ("the source's reset counter counts on", _each(lambda p: {"reset": p.reset + 1})),
    "rare": ("poses at 5 Hz", _rare),
    "shuffle": ("packets overtake each other, by up to 30 ms", _shuffle),
    "double": ("every packet comes twice", lambda poses, fault: [p for p in poses for _ in range(2)]),
}
"""Name -> what happens, and what makes it happen."""


@dataclass
class MocapFault:
    """One fault from a time on; raises `RunError` for an unknown name."""

    name: str
    start: float  # on the plant's clock [s]
    seed: int = 0

    def __post_init__(self) -> None:
        if self.name not in FAULTS:
            raise RunError(f"mocap fault '{self.name}'; {suggest(self.name, FAULTS)}")
        self.rng = np.random.default_rng(self.seed)
        self.last: dict[str, Pose] = {}  # before the fault, by body
        self.kept: dict[str, float] = {}  # stamps of those let through, by body

    def spoil(self, poses: list[Pose], time: float) -> list[Pose]:
        """Return what becomes of the poses that were measured at a time [s], as the source writes them."""
        if time < self.start:
            self.last.update({p.body: p for p in poses})
            return poses
        return FAULTS[self.name][1](poses, self)
