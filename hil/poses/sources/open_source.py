"""Opening of the source that a config names."""

from collections.abc import Callable, Iterable
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np

from hil.errors import SourceError
from hil.links.backends import AUTOPILOTS
from hil.links.clock import Clock, ManualClock
from hil.links.device import check_device, open_port
from hil.links.mavlink_link import Link, LinkSync
from hil.links.roster import Announce, Party, Roster
from hil.links.writer import POSES_TLOG, TLOG, TlogWriter
from hil.params import LIVE, HilParams
from hil.poses.frames import FrameParams, Frames
from hil.poses.pose import Pose, has_attitude
from hil.poses.sources.mavlink import COMPANIONS, MavlinkSource
from hil.poses.sources.motion_capture import (
    MocapParams,
    MocapSource,
    MotionCaptureSource,
    NatNetSource,
    RigidBody,
)
from hil.poses.sources.player import CHANNELS, read_autopilot, read_table, read_tlog
from hil.poses.sources.pose_source import RecordedSource
from hil.poses.sources.ros2 import Ros2Source
from visthrow.logs.check import physics
from visthrow.logs.flightlog import Channel, FlightLog


def read_poses(params: HilParams, roster: Roster | None = None) -> list[Pose]:
    """Return all raw poses of the recording that a config names; raises `SourceError` where the
    file cannot be read. ``roster`` counts what is no pose.
    """
    source = params.source
    if source.kind == "tlog":
        return read_tlog(source.file, source.senders, roster)
    if source.kind in ("bin", "ulg"):
        return read_autopilot(source.file, source.logs, source.kind)
    return read_table(source.file, source.mapping)


def parties(params: HilParams, poses: bool, autopilot: bool) -> list[Party]:
    """Return the parties of a link that carries MAVLink poses, a MAVLink autopilot, or both."""
    bodies = []
    if poses:
        for ids in params.source.senders:
            kinds = frozenset(COMPANIONS.get(ids.message, (ids.message,)))
            bodies.append(Party(ids.body, ids.system, ids.component, kinds))
    if autopilot and params.backend in AUTOPILOTS:
        vehicle = params.vehicle
        bodies.append(
            Party(
                "autopilot",
                vehicle.system,
                vehicle.component,
                autopilot=AUTOPILOTS[params.backend].autopilot,
            )
        )
    return bodies


def open_source(
    params: HilParams,
    folder: Path,
    clock: Clock,
    key: bytes | None = None,
    tell: Announce = None,
) -> tuple[Any, Link | None, Clock]:
    """Open a source: it, the autopilot's link where there is one, and the run's clock, which is put
    from pose to pose where they are recorded; raises `SourceError`, `LinkError`.

    ``key`` signs the links' messages, ``tell`` is handed who is refused and never waits.
    """
    source = params.source
    if source.kind not in LIVE:
        roster = Roster(tell=tell)
        poses = read_poses(params, roster)
        problems = unit_problems(poses, params.frames) if source.check_units else []
        if problems:
            raise SourceError(
                f"{source.file}: {'; '.join(problems)} (source.check_units=false lets it pass)"
            )
        recording = RecordedSource(poses, roster)
        return recording, None, ManualClock(recording.start)
    has_port = source.kind == "mavlink" and source.device is not None

    def open_link(named: str, device: str, tlog: str, who: list[Party]) -> Link:
        port = open_port(
            check_device(device, remote=params.link.remote),
            f"--set {named}=udp:127.0.0.1:PORT, {SENDER}",
        )
        roster = Roster(who, params.link.allow, tell)
        link = Link(
            port, params.link.system, params.link.component, TlogWriter(folder / tlog), roster, key
        )
        if params.delay.synchronise:
            LinkSync(link)
        return link

    link = None
    shared = source.kind == "mavlink" and not has_port
    if shared or params.backend in AUTOPILOTS:
        who = parties(params, shared, True)
        link = open_link("link.device", params.link.device, TLOG, who)
    if source.kind == "mocap":
        remote = params.link.remote
        capture = open_mocap(source.mocap, source.bodies, clock.now, remote, link, tell)
        return capture, link, clock
    if shared:
        return MavlinkSource(link, source.senders, clock.now), link, clock
    poses = open_link("source.device", source.device, POSES_TLOG, parties(params, True, False))
    return MavlinkSource(poses, source.senders, clock.now, link), link, clock


def open_mocap(
    params: MocapParams,
    bodies: tuple[RigidBody, ...],
    clock: Callable[[], float],
    remote: bool,
    link: Link | None = None,
    tell: Announce = None,
) -> MocapSource:
    """Connect to a system; raises `LinkError` for a host that is no numeric address, or leaves this
    machine without the config's leave.
    """
    device = check_device(f"tcp:{params.host}:1", remote=remote)
    params = replace(params, host=device.host)
    return {"natnet": NatNetSource, "ros2": Ros2Source}.get(params.system, MotionCaptureSource)(
        params, bodies, clock, link, tell=tell
    )


SENDER = (  # of a port that is taken
    "and that port in what sends the poses (visthrow hil fake --device udpout:127.0.0.1:PORT)"
)
FEWEST_POSES = 50  # least poses for a judgement
_KINDS = {
    "pos": ("m", "world"),
    "quat": ("1", "world"),
    "vel": ("m/s", "world"),
    "rate": ("rad/s", "body"),
}


def unit_problems(poses: Iterable[Pose], frames: dict[str, FrameParams]) -> list[str]:
    """Return texts on physically impossible motion in a recording's raw poses, by the frames of
    each body; each text names a unit that would explain it.
    """
    poses = list(poses)
    channels = {}
    for body, params in frames.items():
        channels |= _channels(
            [pose for pose in poses if pose.body == body], Frames(params), CHANNELS[body]
        )
    return [
        f"{row.channel}: {row.text}"
        for row in physics.look(FlightLog(channels))
        if (row.topic, row.verdict) == ("units", "bad")
    ]


def _channels(poses: list[Pose], frames: Frames, names: tuple[str, ...]) -> dict[str, Channel]:
    """Return poses of one body as channels in our frames; channels that some poses lack are left
    out.
    """
    ours = [
        frames.pose_from_source(p)
        for p in poses
        if not p.is_lost() and np.all(np.isfinite((p.stamp, p.arrival, *p.pos)))
    ]
    # A clock may be set in between: stamps that do not ascend are left to the gate.
    latest = np.maximum.accumulate([-np.inf, *(p.stamp for p in ours)])
    ours = [p for p, before in zip(ours, latest) if p.stamp > before]
    if len(ours) < FEWEST_POSES:
        return {}
    times = np.array([p.stamp for p in ours])
    channels = {}
    for name, (kind, (unit, frame)) in zip(names, _KINDS.items()):
        values = [getattr(p, kind) for p in ours]
        unknown = any(value is None or not np.all(np.isfinite(value)) for value in values)
        if not unknown and (kind != "quat" or all(map(has_attitude, values))):
            channels[name] = Channel(times, np.array(values), unit, frame)
    return channels
