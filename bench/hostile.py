"""Throws beside hostile datagrams and frames at the readers of pose sources, in lock step.

python -m bench.hostile --source natnet --count 100000 --seeds 10

Each throw is flown on poses that come through the source. From the throw's first tick on,
truncated, random and forged items arrive between them. The runner's decisions must not change, and
each item must be counted."""

import argparse
import math
import struct
from collections.abc import Callable
from dataclasses import dataclass
from types import SimpleNamespace
from typing import Any

import numpy as np

from hil.control.state_machine import State
from hil.poses.pose import PAYLOAD, VEHICLE, Pose
from hil.poses.sources.capture import listen
from hil.poses.sources.motion_capture import (
    MocapParams,
    MocapSource,
    MotionCaptureSource,
    NatNetSource,
    RigidBody,
)
from hil.poses.sources.ros2 import KINDS, Ros2Source
from tests.fuzz import mutate, noise
from tests.hil_flight import AutoOperator, simple_policy
from tests.level import LevelPlant
from tests.loopback.wire import cut, peers
from tests.motive import FRAME, frame, message, server_info
from visthrow.onboard.actions import hover_action

HOST = ("127.0.0.1", 1511)
STRANGER = ("127.0.0.9", 1511)
IDS = {VEHICLE: 7, PAYLOAD: 8}
NUMBERS = {body: str(number) for body, number in IDS.items()}
AT_ONCE = 400
"""Items beside the poses of one read: a source keeps 2000 poses between two reads."""

QUICK = (
    "states.check_hold=0.2",
    "states.armed_least=0.1",
    "states.quiet=0.1",
    "states.land=0.5",
)
WRONG = (math.nan, math.inf, -math.inf, 1e308, -1e30, 0.0)


def _bodies() -> tuple[RigidBody, ...]:
    return tuple(RigidBody(body, name) for body, name in NUMBERS.items())


class NatNet:
    """NatNet's datagrams to the package's parser."""

    kind = "natnet"

    def __init__(self, clock: Callable[[], float]) -> None:
        import natnet

        class Quiet(natnet.NatNetClient):
            """The client without its sockets."""

            def connect(self, timeout: float = 5.0) -> None:
                pass

            def run_async(self) -> None:
                pass

        class Package:
            NatNetClient = Quiet
            packet_buffer = natnet.packet_buffer

        self.source: MocapSource = NatNetSource(
            MocapParams("natnet", HOST[0], multicast=False), _bodies(), clock, module=Package
        )
        self.source.take(server_info(), HOST)
        self._good: list[bytes] = []

    def deliver(self, pose: Pose) -> None:
        """Hand over a pose as the source's peer sends it."""
        self._good.append(frame(pose.stamp, (IDS[pose.body], pose.pos, pose.quat, True)))
        self.source.take(self._good[-1], HOST)

    def attack(self, rng: np.random.Generator) -> None:
        """Hand over one hostile item."""
        kind = rng.integers(5)
        good = self._good[-100:]
        if kind == 0:
            self.source.take(noise(rng), HOST)
        elif kind == 1:  # cut
            data = good[rng.integers(len(good))]
            self.source.take(data[: rng.integers(len(data))], HOST)
        elif kind == 2:  # counts of anything in it
            payload = struct.pack("<4I", 0, *rng.integers(1 << 20, 1 << 31, 3)) + rng.bytes(40)
            self.source.take(message(FRAME, payload), HOST)
        elif kind == 3:
            self.source.take(mutate(rng, good), STRANGER)
        else:  # well formed, from another port of the host's
            self.source.take(
                good[rng.integers(len(good))], (HOST[0], int(rng.integers(2000, 3000)))
            )


class Silent:
    """A stand-in for motioncapture.MotionCapture that the test's thread reads."""

    def __init__(self) -> None:
        self.frames: list[Any] = []

    def waitForNextFrame(self) -> None:
        if isinstance(self.frames[0], Exception):
            raise self.frames.pop(0)

    @property
    def rigidBodies(self) -> Any:
        return self.frames.pop(0)


def _body(pos: Any, quat: Any) -> Any:
    x, y, z, w = quat
    return SimpleNamespace(position=pos, rotation=SimpleNamespace(x=x, y=y, z=z, w=w))


class MotionCapture:
    """Frames of the package motioncapture, as of Vicon, VRPN, Qualisys, ..."""

    kind = "motioncapture"

    def __init__(self, clock: Callable[[], float]) -> None:
        class Unconnected(MotionCaptureSource):
            """The source without its process."""

            def _connect(self) -> None:
                self._ready = SimpleNamespace(is_set=lambda: False, set=lambda: None)
                self._process = None
                self._heard = math.inf

        params = MocapParams("mock", HOST[0])
        self.source = Unconnected(params, _bodies(), clock, tell=lambda text: None)
        self._system = Silent()

    def _flush(self) -> None:
        listen(
            lambda system, options: self._system,
            "mock",
            {},
            [*NUMBERS.values()],
            self.source._take,
            lambda: bool(self._system.frames),
        )

    def deliver(self, pose: Pose) -> None:
        """As of `NatNet`."""
        self._system.frames.append({NUMBERS[pose.body]: _body(pose.pos, pose.quat)})
        self._flush()

    def attack(self, rng: np.random.Generator) -> None:
        """As of `NatNet`."""
        kind = rng.integers(5)
        name = NUMBERS[(VEHICLE, PAYLOAD)[rng.integers(2)]]
        pos = rng.uniform(50.0, 1e6, 3).tolist()
        quat = (0.0, 0.0, 0.0, 1.0)
        if kind == 0:
            item: Any = RuntimeError("occluded")
        elif kind == 1:
            item = {name: object()}
        elif kind == 2:
            item = {name: _body(pos[: rng.integers(3)], quat)}
        elif kind == 3:
            item = [None, 7, {name: None}][rng.integers(3)]
        else:
            pos[rng.integers(3)] = WRONG[rng.integers(3)]
            item = {name: _body(pos, quat)}
        self._system.frames.append(item)
        self._flush()


@dataclass
class Message:
    """As a ROS message, with what Cyclone DDS says of it."""

    header: Any
    pose: Any
    sample_info: Any


class Ros2:
    """Messages of ROS 2 topics."""

    kind = "ros2"

    def __init__(self, clock: Callable[[], float]) -> None:
        class Unconnected(Ros2Source):
            """The source without its subscriptions."""

            def _connect(self) -> None:
                pass

        params = MocapParams("ros2", HOST[0])
        self.source = Unconnected(params, _bodies(), clock, tell=lambda text: None)

    def _take(self, body: str, stamp: Any, pos: Any, quat: Any, publisher: int) -> None:
        point = SimpleNamespace(**dict(zip("xyz", pos)))
        turn = SimpleNamespace(**dict(zip("xyzw", quat)))
        made = Message(
            SimpleNamespace(stamp=stamp),
            SimpleNamespace(position=point, orientation=turn),
            SimpleNamespace(publication_handle=publisher),
        )
        self.source.take(made, KINDS[0], f"/{body}", body, "")

    def deliver(self, pose: Pose) -> None:
        """As of `NatNet`."""
        whole = math.floor(pose.stamp)
        stamp = SimpleNamespace(sec=whole, nanosec=round(1e9 * (pose.stamp - whole)))
        self._take(pose.body, stamp, pose.pos, pose.quat, 1)

    def attack(self, rng: np.random.Generator) -> None:
        """As of `NatNet`."""
        kind = rng.integers(3)
        body = (VEHICLE, PAYLOAD)[rng.integers(2)]
        stamp = SimpleNamespace(sec=int(rng.integers(1 << 31)), nanosec=0)
        pos = rng.uniform(-9.0, 9.0, 3).tolist()
        quat = (0.0, 0.0, 0.0, 1.0)
        if kind == 0:  # another publisher
            self._take(body, stamp, pos, quat, int(rng.integers(2, 99)))
        elif kind == 1:  # fields that lack
            self._take(body, stamp, pos[: rng.integers(3)], quat, 1)
        else:
            pos[rng.integers(3)] = WRONG[rng.integers(3)]
            self._take(body, stamp, pos, quat, 1)


READERS = {reader.kind: reader for reader in (NatNet, MotionCapture, Ros2)}


def fly_beside_hostile(kind: str, seed: int, count: int) -> tuple[list[Any], Any, Any, int]:
    """Fly a throw beside hostile items: the decisions, the fake, the reader, and the number of
    items.

    Args:
        kind: of the source. seed: of the items. count: of items at most.
    """
    hover = hover_action(9.81 * 0.272, 14.0)[0]
    runner, source, clock, fake = peers(
        LevelPlant(), loaded=simple_policy((hover, 0, 0, 0, 1.0)), overrides=QUICK
    )
    reader = READERS[kind](clock.now)
    rng = np.random.default_rng(seed)
    decisions = []
    sent = [0]
    poll = source.poll
    tick = runner.tick

    def poll_hostile(now: float) -> list[Pose]:
        flying = runner.machine.state in (State.THROW, State.RECOVER)
        reader.source.hold(flying)
        poses = poll(now)
        attacks = min(AT_ONCE, count - sent[0]) if flying else 0
        for _ in range(attacks // 2):
            reader.attack(rng)
        for pose in poses:
            reader.deliver(pose)
        for _ in range(attacks - attacks // 2):
            reader.attack(rng)
        sent[0] += attacks
        return reader.source.poll(now)

    def tick_hostile(now: float, *args: Any) -> Any:
        decisions.append(tick(now, *args))
        return decisions[-1]

    source.poll = poll_hostile
    runner.tick = tick_hostile
    cut(runner, source, clock, AutoOperator(), None, 8.0, lambda decision: None)
    counted = reader.source.roster.refused
    counted += sum(track.gate.refused.get("finite", 0) for track in runner.tracks.values())
    return decisions, fake, counted, sent[0]


def judge(kind: str, seed: int, count: int) -> int:
    """Fly throws until so many items have come; returns how many.

    Raises AssertionError: a decision changed, or an item was not counted.
    """
    alone, plain, none, _ = fly_beside_hostile(kind, seed, 0)
    assert plain.witness.releases == 1, "it throws"
    assert none == 0
    total = 0
    while total < count:
        decisions, fake, counted, sent = fly_beside_hostile(
            kind, seed + 1000 * total, count - total
        )
        assert sent, "a throw in which no item arrived proves nothing"
        assert decisions == alone, f"{kind}, seed {seed}: a decision changed"
        assert fake.events == plain.events
        assert counted == sent, f"{kind}, seed {seed}: {counted} of {sent} items were counted"
        total += sent
    return total


def main() -> None:
    """Fly; a line a source and seed."""
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("--source", choices=READERS, action="append")
    parser.add_argument("--count", type=int, default=100_000, metavar="N", help="items a seed")
    parser.add_argument("--seeds", type=int, default=10, metavar="N")
    args = parser.parse_args()
    for kind in args.source or READERS:
        for seed in range(1, args.seeds + 1):
            total = judge(kind, seed, args.count)
            print(f"{kind}, seed {seed}: {total} items, no decision changed, each was counted")


if __name__ == "__main__":
    main()
