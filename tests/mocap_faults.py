"""Faults of a motion capture: from a time on, drawn from a seed, applied to poses as the source
writes them.

python -m tests.mocap_faults NAME TIME hil fake ...    # a fake whose motion capture has the fault
from that time on [s]"""

import math
import sys
from collections.abc import Callable
from dataclasses import dataclass, replace
from typing import Any

import numpy as np

from hil.poses.pose import PAYLOAD, VEHICLE, Pose
from hil.rehearsal import process
from visthrow import cli
from visthrow.common.errors import suggest

RARE = 0.2  # between two poses at 5 Hz [s]
JUMP = 0.5  # [m]
STEP = 1.0  # jump of a clock [s]
SHUFFLE = 0.03  # longest further delay of a pose that may be overtaken [s]

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
    "payload-lost": (
        "the payload is lost, the vehicle is not",
        lambda poses, fault: [p for p in poses if p.body != PAYLOAD],
    ),
    "swap": (
        "vehicle and payload are exchanged",
        _each(lambda p: {"body": {VEHICLE: PAYLOAD, PAYLOAD: VEHICLE}[p.body]}),
    ),
    "jump": ("both bodies jump by 0.5 m", _each(lambda p: {"pos": (p.pos[0] + JUMP, *p.pos[1:])})),
    "order": (
        "quaternions written x, y, z, w for w, x, y, z",
        _each(lambda p: {"quat": (*p.quat[1:], p.quat[0])}),
    ),
    "zero-quaternion": ("quaternions of four zeros", _each(lambda p: {"quat": (0.0,) * 4})),
    "nan-quaternion": (
        "quaternions that are no numbers",
        _each(lambda p: {"quat": (math.nan,) * 4}),
    ),
    "clock-forth": (
        "the source's clock jumps a second ahead",
        _each(lambda p: {"stamp": p.stamp + STEP}),
    ),
    "clock-back": (
        "the source's clock jumps a second back",
        _each(lambda p: {"stamp": p.stamp - STEP}),
    ),
    "reset": ("the source's reset counter counts on", _each(lambda p: {"reset": p.reset + 1})),
    "rare": ("poses at 5 Hz", _rare),
    "shuffle": ("packets overtake each other, by up to 30 ms", _shuffle),
    "double": (
        "every packet comes twice",
        lambda poses, fault: [p for p in poses for _ in range(2)],
    ),
}
"""Name -> description of the fault, and the function that causes it."""


@dataclass
class MocapFault:
    """One fault from a time on; ValueError for an unknown name."""

    name: str
    start: float  # on the plant's clock [s]
    seed: int = 0

    def __post_init__(self) -> None:
        if self.name not in FAULTS:
            raise ValueError(f"mocap fault '{self.name}'; {suggest(self.name, FAULTS)}")
        self.rng = np.random.default_rng(self.seed)
        self.last: dict[str, Pose] = {}  # before the fault, by body
        self.kept: dict[str, float] = {}  # stamps of those let through, by body

    def spoil(self, poses: list[Pose], time: float) -> list[Pose]:
        """Return the poses measured at a time [s] with the fault, as the source writes them."""
        if time < self.start:
            self.last.update({p.body: p for p in poses})
            return poses
        return FAULTS[self.name][1](poses, self)


def main() -> int:
    """Run a command with the fault in the fakes that it makes."""
    name, start, *words = sys.argv[1:]
    load = process.load_fake

    def spoiled(kind: str) -> Any:
        class Spoiled(load(kind)):
            def __init__(self, *args: Any) -> None:
                super().__init__(*args)
                self.spoil = MocapFault(name, float(start), args[3]).spoil

        return Spoiled

    process.load_fake = spoiled
    return cli.main(words)


if __name__ == "__main__":
    sys.exit(main())
