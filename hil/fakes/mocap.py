"""What a motion-capture system makes of the truth: rate, noise, latency and loss, from a seed.

The fake autopilot sends these poses over the wire; the same seed gives a throw flown in the simulator directly the same ones. What
goes wrong with it begins at a stated time, is drawn from a seed as well, and is put into poses as the source writes them.
"""

import math
from collections.abc import Callable
from dataclasses import dataclass, replace
from typing import Any

import numpy as np

from hil.errors import RunError
from hil.poses.pose import PAYLOAD, VEHICLE, Pose
from visthrow.common.errors import suggest
from visthrow.common.mocap import measured

SLACK = 1e-9
"""Tolerance of times that are sums of periods [s]."""

RARE = 0.2
"""Between two poses at 5 Hz [s]."""

JUMP = 0.5
"""[m]."""

STEP = 1.0
"""Jump of a clock [s]."""

SHUFFLE = 0.03
"""Longest further delay of a pose that may be overtaken [s]."""


@dataclass(frozen=True)
class MocapParams:
    """What the motion capture makes of the truth.

    Raises:
        ValueError: a negative number, no rate, or a loss of 1 or more.
    """

    rate: float = 100.0  # poses a second of each body [Hz]
    position_noise: float = 1e-3  # standard deviation [m]
    angle_noise_deg: float = 0.2  # standard deviation about each axis
    latency: float = 0.01  # from the instant of a pose to its sending [s]
    loss: float = 0.02  # share of poses that never come

    def __post_init__(self) -> None:
        if min(vars(self).values()) < 0.0 or not self.rate > 0.0 or not self.loss < 1.0:
            raise ValueError(f"mocap {vars(self)}: expected numbers of 0 or more, a rate above 0, a loss below 1")


class Mocap:
    """Measures vehicle and payload."""

    def __init__(self, params: MocapParams, seed: int = 0) -> None:
        """Begin with a measurement at time 0.

        Args:
            params: its faults.
            seed: of noise and loss.
        """
        self.params = params
        self._rng = np.random.default_rng(seed)
        self._next = 0.0

    def due(self, time: float) -> bool:
        """Whether a measurement is due at a time [s]."""
        return time >= self._next - SLACK

    def measure(self, time: float, truth: dict[str, Any]) -> list[Pose]:
        """Measure both bodies at this instant, which is the due one.

        Args:
            time: [s].
            truth: ``pos_w`` [m], ``quat_wb`` (xyzw) and ``payload_pos_w`` [m].

        Returns:
            Those that are not lost, vehicle first, in our frames; their arrival is the latency after the instant.
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


def _stop(poses: list[Pose], fault: "MocapFault") -> list[Pose]:
    return []


def _repeat(poses: list[Pose], fault: "MocapFault") -> list[Pose]:
    return [replace(fault.last.get(p.body, p), stamp=p.stamp, arrival=p.arrival) for p in poses]


def _lose_payload(poses: list[Pose], fault: "MocapFault") -> list[Pose]:
    return [p for p in poses if p.body != PAYLOAD]


def _swap(poses: list[Pose], fault: "MocapFault") -> list[Pose]:
    other = {VEHICLE: PAYLOAD, PAYLOAD: VEHICLE}
    return [replace(p, body=other[p.body]) for p in poses]


def _turned(quat: tuple[float, ...]) -> Callable[[list[Pose], "MocapFault"], list[Pose]]:
    def change(poses: list[Pose], fault: "MocapFault") -> list[Pose]:
        return [replace(p, quat=quat) for p in poses]

    return change


def _order(poses: list[Pose], fault: "MocapFault") -> list[Pose]:
    return [replace(p, quat=(*p.quat[1:], p.quat[0])) for p in poses]


def _jump(poses: list[Pose], fault: "MocapFault") -> list[Pose]:
    return [replace(p, pos=(p.pos[0] + JUMP, *p.pos[1:])) for p in poses]


def _clock(by: float) -> Callable[[list[Pose], "MocapFault"], list[Pose]]:
    def change(poses: list[Pose], fault: "MocapFault") -> list[Pose]:
        return [replace(p, stamp=p.stamp + by) for p in poses]

    return change


def _reset(poses: list[Pose], fault: "MocapFault") -> list[Pose]:
    return [replace(p, reset=p.reset + 1) for p in poses]


def _rare(poses: list[Pose], fault: "MocapFault") -> list[Pose]:
    kept = [p for p in poses if p.stamp - fault.kept.get(p.body, -math.inf) >= RARE - 1e-6]
    fault.kept.update({p.body: p.stamp for p in kept})
    return kept


def _shuffle(poses: list[Pose], fault: "MocapFault") -> list[Pose]:
    return [replace(p, arrival=p.arrival + SHUFFLE * float(fault.rng.random())) for p in poses]


def _double(poses: list[Pose], fault: "MocapFault") -> list[Pose]:
    return [p for p in poses for _ in range(2)]


FAULTS: dict[str, tuple[str, Callable[[list[Pose], "MocapFault"], list[Pose]]]] = {
    "none": ("nothing goes wrong", lambda poses, fault: poses),
    "stop": ("motion capture stops", _stop),
    "repeat": ("the last pose is repeated", _repeat),
    "payload-lost": ("the payload is lost, the vehicle is not", _lose_payload),
    "swap": ("vehicle and payload are exchanged", _swap),
    "jump": ("both bodies jump by 0.5 m", _jump),
    "order": ("quaternions written x, y, z, w for w, x, y, z", _order),
    "zero-quaternion": ("quaternions of four zeros", _turned((0.0,) * 4)),
    "nan-quaternion": ("quaternions that are no numbers", _turned((math.nan,) * 4)),
    "clock-forth": ("the source's clock jumps a second ahead", _clock(STEP)),
    "clock-back": ("the source's clock jumps a second back", _clock(-STEP)),
    "reset": ("the source's reset counter counts on", _reset),
    "rare": ("poses at 5 Hz", _rare),
    "shuffle": ("packets overtake each other, by up to 30 ms", _shuffle),
    "double": ("every packet comes twice", _double),
}
"""Name -> what happens, and the function that makes it happen."""


@dataclass
class MocapFault:
    """One fault from a time on.

    Raises:
        RunError: an unknown name.
    """

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
        """What becomes of the poses that were measured at a time [s], as the source writes them."""
        if time < self.start:
            self.last.update({p.body: p for p in poses})
            return poses
        return FAULTS[self.name][1](poses, self)
