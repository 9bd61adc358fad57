"""Live poses of motion-capture systems:

``motioncapture`` (Vicon, OptiTrack, Qualisys, VRPN, ...) and ``natnet`` (Motive).

Both packages wait for frames, so each is listened to in a thread of its own, which notes the
arrival and hands the poses over; polling never waits. Axes are those of the system: Vicon and
Qualisys z up, OptiTrack y up; quaternions are xyzw."""

import json
import subprocess
import sys
import threading
from collections import deque
from collections.abc import Callable
from dataclasses import dataclass, field
from typing import Any, Literal

from hil.errors import SourceError
from hil.links.mavlink_link import Link
from hil.poses.pose import BODIES, Body, Pose
from hil.poses.sources.base import Source
from visthrow.common.errors import ConfigError, suggest
from visthrow.common.extras import load_extra

MOST_WAITING = 2000  # poses that are kept between two polls; older ones are dropped

PROBE = (
    "import json, os, sys, motioncapture; motioncapture.connect(sys.argv[1],"
    " json.loads(sys.argv[2])); os._exit(0)"
)
"""Connects once, in a process of its own."""


@dataclass(frozen=True)
class RigidBody:
    """What the motion-capture system calls a body."""

    body: Body
    name: str  # of the rigid body; for natnet its streaming id, for ros2 TYPE:TOPIC

    def __post_init__(self) -> None:
        if not self.name:
            raise ConfigError(
                f"the {self.body} has an empty name; expected what the system calls it"
            )


@dataclass(frozen=True)
class MocapParams:
    """Where the motion-capture system is."""

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
    timeout: float = 5.0  # to connect [s]
    settings: dict[str, str] = field(
        default_factory=dict
    )  # further options of motioncapture.connect; for ros2 domain

    @property
    def options(self) -> dict[str, str]:
        """Of motioncapture.connect."""
        return {"hostname": self.host, **self.settings}


class MocapSource(Source):
    """Poses that a thread hands over, with the autopilot's link served where there is one.

    ``failure`` is what ended the thread, or None; the bodies go stale then, which the runner acts
    on.
    """

    def __init__(self, clock: Callable[[], float], link: Link | None = None) -> None:
        super().__init__(() if link is None else (link,), clock)
        self._waiting: deque[Pose] = deque(maxlen=MOST_WAITING)
        self.failure: str | None = None

    def hand_over(self, pose: Pose) -> None:
        """Take a pose; from any thread."""
        self._waiting.append(pose)

    def poll(self, now: float) -> list[Pose]:
        self.pump()
        return [self._waiting.popleft() for _ in range(len(self._waiting))]


class MotionCaptureSource(MocapSource):
    """Rigid bodies of the package motioncapture, by name. It tells no time: stamps are arrivals."""

    def __init__(
        self,
        params: MocapParams,
        bodies: tuple[RigidBody, ...],
        clock: Callable[[], float],
        link: Link | None = None,
        module: Any = None,
    ) -> None:
        """Connect; ``clock`` gives the arrivals, ``link`` is served, ``module`` stands for the
        package. Raises `SourceError` where that is missing, no body is named, or the system does
        not answer.
        """
        super().__init__(clock, link)
        self._names = body_names(bodies)
        if module is None:
            module = load_extra("motioncapture", "motioncapture", "this source", SourceError)
            _probe(params)
        self._stop, self._ready = threading.Event(), threading.Event()
        # A daemon: waiting for a frame of a system that has gone silent cannot be called off.
        threading.Thread(
            target=self._listen, args=(module.connect, params), name="motioncapture", daemon=True
        ).start()
        if not self._ready.wait(params.timeout) or self.failure is not None:
            self._stop.set()
            raise _no_answer(params, self.failure)

    def _listen(self, connect: Callable[[str, dict[str, str]], Any], params: MocapParams) -> None:
        try:
            system = connect(params.system, params.options)
            self._ready.set()
            while not self._stop.is_set():
                system.waitForNextFrame()
                arrival = self._clock()
                for name, found in system.rigidBodies.items():
                    if name in self._names:
                        q = found.rotation
                        position = tuple(float(x) for x in found.position)
                        self.hand_over(
                            Pose(
                                arrival, arrival, self._names[name], position, (q.x, q.y, q.z, q.w)
                            )
                        )
        except Exception as error:  # whatever the package raises, the runner sees poses that stop
            self.failure = f"{type(error).__name__}: {error}"
            print(f"motion capture stopped: {self.failure}", file=sys.stderr, flush=True)
            self._ready.set()

    def close(self) -> None:
        self._stop.set()
        super().close()


class NatNetSource(MocapSource):
    """Rigid bodies of Motive by streaming id, through the package natnet; stamps are Motive's.

    ``untracked`` counts poses that Motive itself calls not tracked, which it sends on with the last
    position; they are dropped.
    """

    def __init__(
        self,
        params: MocapParams,
        bodies: tuple[RigidBody, ...],
        clock: Callable[[], float],
        link: Link | None = None,
        module: Any = None,
    ) -> None:
        """Connect; arguments and errors as `MotionCaptureSource`, and a name that is no number."""
        super().__init__(clock, link)
        wrong = [body.name for body in bodies if not body.name.isdecimal()]
        if wrong:
            raise SourceError(
                f"natnet bodies {', '.join(wrong)}; expected streaming ids, which are numbers"
            )
        self._names = {int(name): body for name, body in body_names(bodies).items()}
        self.untracked = 0
        module = module or load_extra("natnet", "natnet", "this source", SourceError)
        self._client = module.NatNetClient(
            server_ip_address=params.host,
            local_ip_address=params.local,
            use_multicast=params.multicast,
        )
        self._client.on_data_frame_received_event.handlers.append(self._frame)
        try:
            self._client.connect(timeout=params.timeout)
            self._client.run_async()
        except Exception as error:  # sockets, time-outs, and the package's own
            cast, why = (
                "multi" if params.multicast else "uni",
                str(error) or f"no answer within {params.timeout:g} s",
            )
            text = (
                f"natnet at {params.host} (our address {params.local}, {cast}cast): {why}; expected"
                " Motive that streams"
            )
            raise SourceError(text) from error

    def _frame(self, frame: Any) -> None:
        arrival = self._clock()
        for found in frame.rigid_bodies:
            body = self._names.get(found.id_num)
            if body is None:
                continue
            if found.tracking_valid is False:  # None before NatNet 2.6, which does not say
                self.untracked += 1
                continue
            self.hand_over(
                Pose(
                    float(frame.suffix.timestamp), arrival, body, tuple(found.pos), tuple(found.rot)
                )
            )

    def close(self) -> None:
        self._client.shutdown()
        super().close()


def body_names(bodies: tuple[RigidBody, ...]) -> dict[str, str]:
    """Return our body by the system's name; raises `SourceError` for none, or one twice."""
    names = {body.name: body.body for body in bodies}
    if not names or len(names) != len(bodies) or len(set(names.values())) != len(bodies):
        raise SourceError(
            f"source.bodies {[(b.body, b.name) for b in bodies]}; expected each body once, with a"
            f" name of its own. {suggest('', BODIES)}"
        )
    return names


def _no_answer(params: MocapParams, why: str | None) -> SourceError:
    why = why or f"no answer within {params.timeout:g} s"
    return SourceError(
        f"{params.system} at {params.host}: {why}; expected a motion-capture system that streams"
    )


def _probe(params: MocapParams) -> None:
    """Try whether the system answers: the package's connect holds the interpreter until it does,
    and would hold the run as well.
    """
    command = [sys.executable, "-c", PROBE, params.system, json.dumps(params.options)]
    try:
        tried = subprocess.run(
            command, timeout=params.timeout, capture_output=True, text=True, check=False
        )
    except subprocess.TimeoutExpired:
        raise _no_answer(params, None) from None
    if tried.returncode:
        raise _no_answer(
            params, (tried.stderr.strip().splitlines() or [f"status {tried.returncode}"])[-1]
        )
