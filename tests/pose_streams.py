"""Streams of poses as bridges send them, good and bad: datagrams of vehicle and payload at rest, in
lock step, for ``hil check`` and for a run.
"""

import math
from collections.abc import Callable, Iterator
from dataclasses import dataclass, field

import numpy as np

from hil.links.mavlink_link import Link
from hil.links.pymav import mav
from hil.links.roster import Roster
from hil.params import HilParams
from hil.poses.sources.mavlink import MavlinkSource
from hil.poses.sources.open_source import parties
from tests.loopback.wire import HERE, pipe

SECONDS = 3.0
SECOND_SENDER = ("127.0.0.1", 2)

Sample = tuple[float, float, int]  # arrival [s], stamp [us], number


def regular(rate: float) -> Callable[[np.random.Generator], Iterator[Sample]]:
    """Samples at a rate [Hz], each arriving 10 ms after its measurement."""

    def samples(rng):
        for n in range(int(SECONDS * rate)):
            yield n / rate + 0.01, 1_000_000 + round(1e6 * n / rate), n

    return samples


def restamp(change: Callable[[Sample], float]):
    """Regular samples of 100 Hz with other stamps [us]."""

    def samples(rng):
        for sample in regular(100.0)(rng):
            yield sample[0], max(0, round(change(sample))), sample[2]

    return samples


def jitter(rng):
    """Each pose is stamped when it is forwarded, up to 15 ms after its time."""
    for arrival, _, n in sorted(
        (a + 0.015 * rng.random(), s, n) for a, s, n in regular(100.0)(rng)
    ):
        yield arrival, round(1e6 * (1.0 + arrival)), n


def bursts(rng):
    """Poses of 300 Hz are forwarded every 60 ms, 0.1 ms apart."""
    for _, stamp, n in regular(300.0)(rng):
        yield 0.06 * (n // 18 + 1) + 1e-4 * (n % 18), stamp, n


@dataclass(frozen=True)
class PoseStream:
    """A stream, and the check's message; empty where it is good."""

    says: str
    samples: Callable[[np.random.Generator], Iterator[Sample]] = field(default=regular(100.0))
    quat: tuple[float, ...] = (1.0, 0.0, 0.0, 0.0)
    ball: tuple[float, ...] | None = None  # the payload's attitude, where it is another
    frame: int = mav.MAV_FRAME_LOCAL_NED
    quality: int = 0
    wrong: int = 0  # of so many poses one jumps
    second: bool = False  # a second sender speaks as both


STREAMS = {
    "50 Hz": PoseStream("", regular(50.0)),
    "100 Hz": PoseStream(""),
    "300 Hz": PoseStream("", regular(300.0)),
    "two senders": PoseStream("", second=True),
    "a ball of NaN": PoseStream("", ball=(math.nan,) * 4),
    "a ball of zeros": PoseStream("", ball=(0.0,) * 4),
    "1 Hz": PoseStream("vehicle: 1.0 good poses a second; expected 36 or more", regular(1.0)),
    "8 Hz": PoseStream("8.0 good poses a second; expected 36 or more", regular(8.0)),
    "zero": PoseStream("stamps are 0 s: the sender does not stamp", restamp(lambda s: 0)),
    "constant": PoseStream("stamps are 5 s: the sender does not stamp", restamp(lambda s: 5e6)),
    "huge": PoseStream(
        "stamps that are no time)",
        restamp(lambda s: 2**63 + s[1]),
    ),
    "backward": PoseStream("stamps run backward, from", restamp(lambda s: 1e9 - s[1])),
    "ahead": PoseStream("stamps advance by 1e+03 s in a second", restamp(lambda s: 1e3 * s[1])),
    "nan": PoseStream("NaN instead of unit quaternions: the source gives", quat=(math.nan,) * 4),
    "no quaternion": PoseStream("no good pose of the vehicle", quat=(0.0,) * 4),
    "frame": PoseStream("frame LOCAL_FLU is not taken", frame=mav.MAV_FRAME_LOCAL_FLU),
    "quality": PoseStream("the source says that it does not see the body)", quality=-1),
    "jitter": PoseStream("stamps scatter by 4", jitter),
    "bursts": PoseStream("they come in bursts", bursts),
    "half refused": PoseStream("50 % of the poses are refused (", wrong=2),
    "700 Hz": PoseStream("700 poses a second; expected 582 at most", regular(700.0)),
}
"""Good streams, then bad ones."""


class Sent(MavlinkSource):
    """A stream as the source of a config whose clock the test sets."""

    start = 0.0

    def __init__(self, params: HilParams, stream: PoseStream) -> None:
        port, _ = pipe()
        super().__init__(
            Link(port, roster=Roster(parties(params, True, False))),
            params.source.senders,
            lambda: 0.0,
        )
        rng = np.random.default_rng(0)
        self._datagrams = sorted(_datagrams(stream, rng), key=lambda row: row[0])
        self._next = 0

    @property
    def ended(self) -> bool:  # type: ignore[override]
        return self._next >= len(self._datagrams)

    def wait(self, clock, until):
        clock.sleep_until(until)

    def poll(self, now):
        while not self.ended and self._datagrams[self._next][0] <= now:
            arrival, data, sender = self._datagrams[self._next]
            self._next += 1
            self._link.port.inbox.append((data, sender))
            self._link.pump(lambda arrival=arrival: arrival)
        poses, self._waiting = self._waiting, []
        return poses


def _datagrams(stream: PoseStream, rng: np.random.Generator) -> Iterator[tuple]:
    packers = {component: mav.MAVLink(None, 1, component) for component in (1, 25)}
    for arrival, stamp, n in stream.samples(rng):
        for component, height in ((1, -1.333), (25, -0.95)):
            noise = 5e-4 * rng.standard_normal(3)
            x, y, z = noise + [0.4 * (stream.wrong > 0 and n % stream.wrong == 1), 0.0, height]
            body = (x, y, z, list(stream.ball if component == 25 and stream.ball else stream.quat))
            rest = (*[math.nan] * 6, [0.0] * 21, [0.0] * 21, 0, 0, stream.quality)
            message = mav.MAVLink_odometry_message(
                stamp, stream.frame, mav.MAV_FRAME_BODY_FRD, *body, *rest
            )
            data = message.pack(packers[component])
            yield arrival, data, HERE
            if stream.second:
                yield arrival + 0.003, data, SECOND_SENDER
