"""The fake autopilot's process: a fake around an injected plant, flown in real time."""

import contextlib
import importlib
import inspect
import json
import math
import signal
import socket
from pathlib import Path
from typing import Any

from hil.control.realtime import collected
from hil.errors import LinkError, RunError
from hil.links.clock import Clock
from hil.links.device import LARGEST_DATAGRAM, UdpPort, refused
from hil.links.mavlink_link import Link
from hil.rehearsal.fake import Fake, Options, WirePlant
from hil.rehearsal.fake_ardupilot import FakeArduPilot
from hil.rehearsal.fake_betaflight import FakeBetaflight
from hil.rehearsal.fake_crazyflie import FakeCrazyflie
from hil.rehearsal.fake_mocap import MocapParams
from hil.rehearsal.fake_px4 import FakePx4
from visthrow.common.arguments import StopRequest
from visthrow.common.errors import suggest

KINDS = {
    "ardupilot": FakeArduPilot,
    "px4": FakePx4,
    "betaflight": FakeBetaflight,
    "crazyflie": FakeCrazyflie,
}
# the process ends this long after the payload has landed [s]: the vehicle has landed by then
AFTER_LANDING = 10.0


def load_plant(target: str, policy: str, seed: int) -> WirePlant:
    """Call ``module:function`` with policy and seed; raises `RunError` where there is none, or one
    that makes no plant of these two.
    """
    module, _, name = target.partition(":")
    try:
        make = getattr(importlib.import_module(module), name)
        inspect.signature(make).bind(policy, seed)
    except (ImportError, AttributeError, ValueError, TypeError) as error:
        raise RunError(
            f"plant '{target}': {error}; expected module:function, as"
            " visthrow.throws.wire_plant:make, called with policy and seed"
        ) from error
    return make(policy, seed)


class ListeningPort:
    """A TCP port of this machine that serves one peer at a time: what a flight controller in
    software offers.
    """

    whole, sender, peer = False, None, None

    def __init__(self, number: int, other: str = "") -> None:
        """Listen on a port of the loopback address; raises `LinkError` where it is taken, or there
        is none of that number.

        ``other``: as of `hil.links.device.refused`.
        """
        if not 1 <= number <= 65535:
            raise LinkError(f"tcp port {number}; expected 1 to 65535")
        try:
            self._server = socket.create_server(("127.0.0.1", number), backlog=1)
        except OSError as error:
            raise refused(f"tcp:127.0.0.1:{number}", number, error, other) from error
        self._server.setblocking(False)
        self._peer: socket.socket | None = None

    def read(self) -> bytes | None:
        if self._peer is None:
            try:
                self._peer, _ = self._server.accept()
            except OSError:
                return None
            self._peer.setblocking(False)
            self._peer.setsockopt(socket.IPPROTO_TCP, socket.TCP_NODELAY, 1)
        try:
            data = self._peer.recv(LARGEST_DATAGRAM)
        except BlockingIOError:
            return None
        except OSError:
            data = b""
        if not data:  # the peer has gone: the next one may come
            self._peer.close()
            self._peer = None
        return data or None

    def write(self, data: bytes, to: tuple[str, int] | None = None) -> bool:
        try:
            return self._peer is not None and self._peer.send(data) == len(data)
        except OSError:
            return False

    def fileno(self) -> int:
        return (self._peer or self._server).fileno()

    def close(self) -> None:
        for one in (self._server, self._peer):
            if one is not None:
                one.close()


class AnsweringPort(UdpPort):
    """A UDP port that answers whoever spoke last: what a vehicle in software offers."""

    def write(self, data: bytes, to: tuple[str, int] | None = None) -> bool:
        return super().write(data, to or self.sender)


def make_fake(
    kind: str,
    plant: WirePlant,
    link: Link,
    mocap: MocapParams | None = None,
    seed: int = 0,
    options: Options | None = None,
    port: Any = None,
) -> Fake:
    """Return a fake of a kind, with its port of MSP for Betaflight, of CRTP for the Crazyflie;
    raises `RunError` for an unknown kind.
    """
    if kind not in KINDS:
        raise RunError(f"fake of kind '{kind}'; {suggest(kind, KINDS)}")
    return KINDS[kind](plant, link, mocap, seed, options, port)


def serve(
    fake: Fake, clock: Clock, most: float, out: Path | None = None, after: float = AFTER_LANDING
) -> dict[str, Any]:
    """Fly in real time, or on a firmware's clock, until ``after`` seconds after the landing, for
    ``most`` seconds, or until Ctrl-C; returns the report.
    """
    plant, begun, late = fake.plant, fake.plant.time, 0
    # where the machine is late the vehicle's clock is as late as the vehicle
    start = clock.now() - begun
    heard: list[tuple[float, float]] = []  # first and last period on a firmware's clock
    fake.wall = lambda: plant.time + min(max(clock.now() - start - plant.time, 0.0), plant.period)
    fake.question_lag = 0.0
    asked = StopRequest((signal.SIGINT,))
    with (
        contextlib.suppress(KeyboardInterrupt),
        asked as stop,
        collected(),
    ):  # a collection of all takes a tenth of a second
        while plant.time - begun < most and not stop.asked:
            time = plant.time + plant.period
            due = start + time
            if fake.paced:
                start, due = clock.now() - plant.time, -math.inf
                heard = [*heard[:1], (clock.now(), plant.time)]
            late += math.isfinite(due) and clock.now() > due
            while clock.now() < due:  # what comes meanwhile acts from when it comes
                clock.wait_for([fake.port], due)
                fake.hear()
            fake.deliver(time)  # poses leave before a period is worked out
            fake.step()
            landed = plant.landing["landing_time"]
            if landed is not None and plant.time > landed + after:
                break
    report = {**fake.report(), "late_periods": late}
    if len(heard) > 1:
        (begin, first), (end, last) = heard
        report["speed"] = (last - first) / max(end - begin, 1e-9)
    if out is not None:
        out.write_text(json.dumps(report, indent=2) + "\n", encoding="utf-8")
    return report
