"""Live poses of motion-capture systems:

``motioncapture`` (Vicon, OptiTrack, Qualisys, VRPN, ...) and ``natnet`` (Motive).

Both packages block until a frame arrives. So a separate thread reads each of them, records the
arrival and queues the poses; polling never waits. Invalid data is dropped, counted and reported
once with its sender; no datagram or frame ends a thread. Axes are those of the system: Vicon and
Qualisys z up, OptiTrack y up; quaternions are xyzw."""

import functools
import importlib.util
import json
import math
import socket
import struct
import subprocess
import sys
import tempfile
import threading
from collections import deque
from collections.abc import Callable
from dataclasses import dataclass, field
from time import monotonic, sleep
from typing import Any, Literal

from hil.errors import SourceError
from hil.links.mavlink_link import Link
from hil.links.roster import Announce, Roster
from hil.poses.pose import BODIES, Body, Pose
from hil.poses.sources import capture
from hil.poses.sources.capture import PAUSE, listen
from hil.poses.sources.pose_source import Source
from visthrow.common.errors import ConfigError, suggest
from visthrow.common.extras import load_extra
from visthrow.config.bounds import Bounded, Positive

MOST_WAITING = 2000  # most poses kept between two polls; older ones are dropped

HEADER = struct.Struct("<HH")  # of NatNet's datagrams: message and length of what follows
# messages
SERVER_INFO = 1
FRAME = 7
IGNORED = (1, 3, 5, 8, 100)  # ignored
RESTART_DELAY = 1.0  # before a capture that has ended is restarted, on the ground [s]
QUIET = 5.0  # time without a frame after which it is restarted on the ground: it may hang [s]
ENDING = 2.0  # longest wait for threads and processes to end [s]


@dataclass(frozen=True)
class RigidBody:
    """The motion-capture system's name of a body."""

    body: Body
    name: str  # of the rigid body; for natnet its streaming id, for ros2 TYPE:TOPIC

    def __post_init__(self) -> None:
        if not self.name:
            raise ConfigError(
                f"the {self.body} has an empty name; expected what the system calls it"
            )


@dataclass(frozen=True)
class MocapParams(Bounded):
    """The address of the motion-capture system."""

    # "natnet" through the package natnet, "ros2" through cyclonedds, all others through
    # motioncapture; "mock" is for tests.
    system: Literal[
        "vicon",
        "optitrack",
        "optitrack_closed_source",
        "qualisys",
        "nokov",
        "vrpn",
        "motionanalysis",
        "natnet",
        "ros2",
        "mock",
    ]
    # numeric address of the system's computer (ros2: of our network card); link.remote must allow
    # one other than loopback
    host: str
    local: str = "127.0.0.1"  # natnet: address of our own network card
    multicast: bool = True  # natnet: as Motive's transmission type
    timeout: Positive = 5.0  # to connect [s]
    # further options of motioncapture.connect; for ros2 domain
    settings: dict[str, str] = field(default_factory=dict)

    @property
    def options(self) -> dict[str, str]:
        """Arguments of motioncapture.connect."""
        return {"hostname": self.host, **self.settings}


class MocapSource(Source):
    """Poses that a thread hands over, with the autopilot's link served where there is one.

    ``failure`` is what ended the thread, or None; the bodies go stale then, which the runner acts
    on. ``roster`` counts what came and is no pose.
    """

    def __init__(
        self,
        params: MocapParams,
        bodies: tuple[RigidBody, ...],
        clock: Callable[[], float],
        link: Link | None = None,
        module: Any = None,
        tell: Announce = None,
    ):
        """Connect; ``clock`` gives the arrivals, ``link`` is served, ``tell`` is handed what is
        dropped, ``module`` stands for the package, in this process. Raises `SourceError` where that
        is missing, no body is named or by no name of the system, or the system does not answer.
        """
        super().__init__(() if link is None else (link,), clock)
        self._waiting: deque[Pose] = deque(maxlen=MOST_WAITING)
        self._tell = tell or (lambda text: print(text, file=sys.stderr, flush=True))
        self.failure: str | None = None
        self.roster = Roster(tell=tell)
        self.rosters.append(self.roster)
        self._params = params
        self._module = module
        self._names = body_names(bodies)
        self._connect()

    def _connect(self) -> None:
        """Connect to the system."""
        raise NotImplementedError

    def hand_over(self, pose: Pose) -> None:
        """Queue a pose; callable from any thread."""
        self._waiting.append(pose)

    def poll(self, time: float) -> list[Pose]:
        self.pump()
        return [self._waiting.popleft() for _ in range(len(self._waiting))]


class MotionCaptureSource(MocapSource):
    """Rigid bodies of the package motioncapture, by name. It tells no time: stamps are arrivals.

    The package runs in a process of its own (`hil.poses.sources.capture`). Where that ends, the
    source says why, and starts it again on the ground.
    """

    stamped = False

    def _connect(self) -> None:
        params = self._params
        if self._module is None and importlib.util.find_spec("motioncapture") is None:
            load_extra("motioncapture", "motioncapture", "this source", SourceError)
        self._stop = threading.Event()
        self._ready = threading.Event()
        self._process: subprocess.Popen | None = None
        self._heard = math.inf
        self._said = ""
        self._thread = threading.Thread(
            target=self._keep_listening, name="motioncapture", daemon=True
        )
        self._thread.start()
        answered = self._ready.wait(params.timeout)
        why = self.failure if answered else f"no answer within {params.timeout:g} s"
        if why is not None:
            self._end()
            raise SourceError(
                f"{params.system} at {params.host}: {why}; expected a motion-capture system that"
                " streams"
            )

    def _keep_listening(self) -> None:
        while not self._stop.is_set():
            try:
                self._listen() if self._module is None else self._listen_here()
            except Exception as error:  # whatever the package raises, the run goes on
                self.failure = f"{type(error).__name__}: {error}"
            first = not self._ready.is_set()
            stopping = self._stop.is_set()
            self._ready.set()
            if first or stopping:
                return
            self._say(f"motion capture stopped: {self.failure}; it is started again on the ground")
            self._stop.wait(RESTART_DELAY)
            while self.roster.flying and not self._stop.wait(0.1):
                pass

    def _say(self, text: str) -> None:
        """Report a line, unless it was the last one reported."""
        if text != self._said:
            self._said = text
            self._tell(text)

    def poll(self, time: float) -> list[Pose]:
        quiet = monotonic() - self._heard > QUIET and not self.roster.flying
        if quiet and self._process is not None:
            self._heard = math.inf
            self._process.kill()
        return super().poll(time)

    def _listen_here(self) -> None:
        p = self._params
        stopped = self._stop.is_set
        listen(
            self._module.connect,
            p.system,
            p.options,
            [*self._names],
            self._take,
            lambda: not stopped(),
        )

    def _listen(self) -> None:
        """Read what the process writes until it ends; raises `SourceError` with its last words."""
        p = self._params
        settings = [p.system, json.dumps(p.options), json.dumps([*self._names])]
        with (
            tempfile.TemporaryFile("w+") as words,
            subprocess.Popen(
                [sys.executable, "-P", capture.__file__, *settings],
                stdin=subprocess.DEVNULL,
                stdout=subprocess.PIPE,
                stderr=words,
                text=True,
            ) as process,
        ):
            self._process = process
            self._heard = monotonic()
            for line in process.stdout:
                self._take(json.loads(line))
            status = process.wait()
            words.seek(0)
            lines = words.read().strip().splitlines()
        if self._heard == math.inf:
            raise SourceError(f"no frame for {QUIET:g} s")
        raise SourceError(lines[-1] if lines and status > 0 else f"its process ended with {status}")

    def _take(self, value: Any) -> None:
        """Process an item of `hil.poses.sources.capture.listen`."""
        arrival = self._clock()
        host = (self._params.host, 0)
        if value is None:
            if self._ready.is_set():
                self._say("motion capture is connected again")
            self.failure = None
            self._ready.set()
        elif isinstance(value, str):
            self.roster.drop(host, *value.split(": ", 1))
        elif isinstance(value, int):
            self.roster.drop(("others", 0), "datagram", f"source.mocap.host is {host[0]}", value)
        else:
            self._heard = monotonic()
            for name, (*pos, x, y, z, w) in value.items():
                self.hand_over(Pose(arrival, arrival, self._names[name], tuple(pos), (x, y, z, w)))

    def _end(self) -> None:
        self._stop.set()
        if self._process is not None:
            self._process.kill()
            self._thread.join(ENDING)

    def close(self) -> None:
        self._end()
        super().close()


class NatNetSource(MocapSource):
    """Rigid bodies of Motive by streaming id, through the package natnet; stamps are Motive's.

    The package's threads accept datagrams of any sender, and end at the first that they cannot
    read. So each datagram is checked first: only parseable frames of the host reach the package.
    """

    def _connect(self) -> None:
        params = self._params
        wrong = [name for name in self._names if not name.isdecimal()]
        if wrong:
            raise SourceError(
                f"natnet bodies {', '.join(wrong)}; expected streaming ids, which are numbers"
            )
        self._ids = {int(name): body for name, body in self._names.items()}
        self._module = self._module or load_extra("natnet", "natnet", "this source", SourceError)
        self._client = self._module.NatNetClient(
            server_ip_address=params.host,
            local_ip_address=params.local,
            use_multicast=params.multicast,
        )
        self._client.on_data_frame_received_event.handlers.append(self._frame)
        # The package has no seam for it: its own method reads the socket and forgets the sender.
        self._client._NatNetClient__process_socket = self._receive
        try:
            self._client.connect(timeout=params.timeout)
            self._client.run_async()
        except Exception as error:  # sockets, time-outs, and the package's own
            cast = "multi" if params.multicast else "uni"
            why = str(error) or f"no answer within {params.timeout:g} s"
            text = (
                f"natnet at {params.host} (our address {params.local}, {cast}cast): {why}; expected"
                " Motive that streams"
            )
            raise SourceError(text) from error

    def _receive(
        self, sock: socket.socket, recv_buffer_size: int = 65536, send_keep_alive: bool = False
    ) -> bool:
        """Take one datagram of a socket of the client; whether there was one."""
        try:
            if send_keep_alive:
                self._client.send_request(self._client.NAT_KEEPALIVE)
            data, sender = sock.recvfrom(recv_buffer_size)
        except TimeoutError:
            return False
        except OSError:  # none is there; or the host's port is closed, or the network is gone
            sleep(PAUSE)
            return False
        self.take(data, sender)
        return True

    def take(self, data: bytes, sender: tuple[str, int]) -> None:
        """Take a datagram: an answer of the host before it is known, then its frames; what is
        neither is dropped and counted.
        """
        if sender[0] != self._params.host:
            self.roster.drop(sender, "datagram", f"source.mocap.host is {self._params.host}")
            return
        kind, size = HEADER.unpack_from(data) if len(data) >= HEADER.size else (None, 0)
        expected_kind = FRAME if self._client.server_info is not None else SERVER_INFO
        if kind != expected_kind and kind in IGNORED and len(data) >= HEADER.size + size:
            return
        if kind != expected_kind or len(data) < HEADER.size + size:
            self.roster.drop(sender, "datagram", "no NatNet message, or cut short")
            return
        if kind == FRAME and not self.roster.claim("Motive", sender, self._clock()):
            return
        try:
            self._client._NatNetClient__process_message(
                bound_buffer(self._module)(data[: HEADER.size + size])
            )
        except Exception as error:  # of the package, at whatever the datagram holds
            self.roster.drop(sender, "datagram", f"does not parse ({type(error).__name__})")

    def _frame(self, frame: Any) -> None:
        arrival = self._clock()
        for rigid_body in frame.rigid_bodies:
            body = self._ids.get(rigid_body.id_num)
            if body is not None:
                stamp = float(frame.suffix.timestamp)
                pos = tuple(rigid_body.pos)
                rot = tuple(rigid_body.rot)
                # None before NatNet 2.6, which does not say. Motive sends the last position on.
                valid = rigid_body.tracking_valid is not False
                self.hand_over(Pose(stamp, arrival, body, pos, rot, valid=valid))

    def close(self) -> None:
        self._client.shutdown()
        super().close()


@functools.cache
def bound_buffer(module: Any) -> Any:
    """Return the package's buffer, which believes no count that is larger than the datagram."""

    class BoundedBuffer(module.packet_buffer.PacketBuffer):
        def read_float32_array(self, count: int) -> tuple[float, ...]:
            if 4 * count > len(self.data) - self.pointer:
                raise ValueError(f"{count} numbers in {len(self.data)} bytes")
            return super().read_float32_array(count)

    return BoundedBuffer


def body_names(bodies: tuple[RigidBody, ...]) -> dict[str, str]:
    """Return our body by the system's name; raises `SourceError` for none, or one twice."""
    names = {body.name: body.body for body in bodies}
    if not names or len(names) != len(bodies) or len(set(names.values())) != len(bodies):
        raise SourceError(
            f"source.bodies {[(b.body, b.name) for b in bodies]}; expected each body once, with a"
            f" name of its own. {suggest('', BODIES)}"
        )
    return names
