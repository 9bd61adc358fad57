"""Sources of poses behind one face, live and replayed alike: MAVLink, .tlog, .BIN, .ulg, CSV, motion-capture systems.

A source hands on raw poses, in its own frames; `hil.poses.frames` converts them.
"""

from hil.sources.base import Recorded, Source
from hil.sources.mavlink import BodyIds, MavlinkDecoder, MavlinkSource
from hil.sources.mocap import MocapParams, RigidBody, open_mocap
from hil.sources.player import CHANNELS, LogBody, read_autopilot, read_table, read_tlog

__all__ = [
    "CHANNELS", "BodyIds", "LogBody", "MavlinkDecoder", "MavlinkSource", "MocapParams", "Recorded", "RigidBody", "Source", "open_mocap",
    "read_autopilot", "read_table", "read_tlog",
]  # fmt: skip
