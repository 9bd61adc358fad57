"""Opens the source that a config names."""

from pathlib import Path
from typing import Any

from hil.errors import LinkError, SourceError
from hil.links.clock import MonotonicClock
from hil.links.device import check_device, open_port
from hil.links.mavlink_link import Link, TlogWriter
from hil.links.sync import LinkSync
from hil.params import LIVE, HilParams
from hil.poses.plausible import unit_problems
from hil.poses.pose import Pose
from hil.recording.record import TLOG
from hil.sources.base import Recorded
from hil.sources.mavlink import MavlinkSource
from hil.sources.mocap import open_mocap
from hil.sources.player import read_autopilot, read_table, read_tlog


def read_poses(params: HilParams) -> list[Pose]:
    """All raw poses of the recording that a config names.

    Raises:
        SourceError: the file cannot be read, or is not what the config says.
    """
    source = params.source
    if source.kind == "tlog":
        return read_tlog(source.file, source.senders)
    if source.kind in ("bin", "ulg"):
        return read_autopilot(source.file, source.logs, source.kind)
    return read_table(source.file, source.mapping)


def open_source(params: HilParams, folder: Path, speed: float) -> tuple[Any, Link | None, bool]:
    """Open a source.

    Args:
        params: the run.
        folder: of the run, where a link's .tlog goes.
        speed: of the clock.

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
    clock, link = MonotonicClock(speed).now, None
    if source.kind == "mavlink" or params.backend in ("ardupilot", "px4"):
        port = open_port(check_device(params.link.device, remote=params.link.remote))
        try:
            folder.mkdir(parents=True, exist_ok=True)
        except OSError as error:
            raise LinkError(f"cannot make {folder}: {error.strerror}; expected a folder that can be written (--out)") from error
        link = Link(port, params.link.system, params.link.component, TlogWriter(folder / TLOG))
        if params.delay.synchronise:
            LinkSync(link)
    if source.kind == "mavlink":
        return MavlinkSource(link, source.senders, clock), link, False
    return open_mocap(source.mocap, source.bodies, clock, params.link.remote, link), link, False
