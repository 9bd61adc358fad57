"""Opens the source that a config names."""

from collections.abc import Callable
from pathlib import Path
from typing import Any

from hil.backends import AUTOPILOTS
from hil.errors import SourceError
from hil.links.clock import Clock
from hil.links.device import check_device, open_port
from hil.links.mavlink_link import Link
from hil.links.roster import Party, Roster
from hil.links.sync import LinkSync
from hil.links.writer import TlogWriter
from hil.params import LIVE, HilParams
from hil.poses.plausible import unit_problems
from hil.poses.pose import Pose
from hil.recording.record import POSES_TLOG, TLOG
from hil.sources.base import Recorded
from hil.sources.mavlink import COMPANIONS, MavlinkSource
from hil.sources.mocap import open_mocap
from hil.sources.player import read_autopilot, read_table, read_tlog
from hil.sources.ros2 import Ros2Source


def read_poses(params: HilParams) -> list[Pose]:
    """Return all raw poses of the recording that a config names; raises `SourceError` where the file cannot be read."""
    source = params.source
    if source.kind == "tlog":
        return read_tlog(source.file, source.senders)
    if source.kind in ("bin", "ulg"):
        return read_autopilot(source.file, source.logs, source.kind)
    return read_table(source.file, source.mapping)


def parties(params: HilParams, poses: bool, autopilot: bool) -> list[Party]:
    """Return who may speak on a link that carries MAVLink poses, or the autopilot where that speaks MAVLink, or both."""
    found = []
    if poses:
        for ids in params.source.senders:
            kinds = frozenset(COMPANIONS.get(ids.message, (ids.message,)))
            found.append(Party(ids.body, ids.system, ids.component, kinds))
    if autopilot and params.backend in AUTOPILOTS:
        vehicle = getattr(params, params.backend)
        found.append(Party("autopilot", vehicle.system, vehicle.component, autopilot=AUTOPILOTS[params.backend].autopilot))
    return found


def open_source(
    params: HilParams, folder: Path, clock: Clock, key: bytes | None = None, tell: Callable[[str], None] | None = None
) -> tuple[Any, Link | None, bool]:  # fmt: skip
    """Open a source; ``key`` signs the links' messages, ``tell`` is handed who is refused and never waits.

    Returns:
        Source of poses, the autopilot's link where there is one, and whether the poses are recorded ones.

    Raises:
        SourceError, LinkError: it cannot be opened; the message says what was expected.
    """
    source = params.source
    if source.kind not in LIVE:
        poses = read_poses(params)
        problems = unit_problems(poses, params.frames) if source.check_units else []
        if problems:
            raise SourceError(f"{source.file}: {'; '.join(problems)} (source.check_units=false lets it pass)")
        return Recorded(poses), None, True
    own = source.kind == "mavlink" and source.device is not None

    def opened(device: str, tlog: str, who: list[Party]) -> Link:
        port = open_port(check_device(device, remote=params.link.remote))
        roster = Roster(who, params.link.allow, tell)
        link = Link(port, params.link.system, params.link.component, TlogWriter(folder / tlog), roster, key)
        if params.delay.synchronise:
            LinkSync(link)
        return link

    link = None
    if (source.kind == "mavlink" and not own) or params.backend in AUTOPILOTS:
        link = opened(params.link.device, TLOG, parties(params, source.kind == "mavlink" and not own, True))
    if source.kind != "mavlink" and source.mocap.system == "ros2":
        check_device(f"tcp:{source.mocap.host}:1", remote=params.link.remote)
        return Ros2Source(source.mocap, source.bodies, clock.now, link), link, False
    if source.kind != "mavlink":
        return open_mocap(source.mocap, source.bodies, clock.now, params.link.remote, link), link, False
    if not own:
        return MavlinkSource(link, source.senders, clock.now), link, False
    poses = opened(source.device, POSES_TLOG, parties(params, True, False))
    return MavlinkSource(poses, source.senders, clock.now, link), link, False
