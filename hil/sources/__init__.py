"""Sources of poses behind one face, live and replayed alike: MAVLink, .tlog, .BIN, .ulg, CSV, motion-capture systems.

A source hands on raw poses, in its own frames; `hil.poses.frames` converts them.
"""

from hil.sources.base import Recorded, Source
from hil.sources.csv_file import Column, CsvParams, read_csv
from hil.sources.dataflash import read_bin
from hil.sources.logs import LogBody
from hil.sources.mavlink import BodyIds, MavlinkDecoder, MavlinkSource, read_tlog
from hil.sources.mocap import MocapParams, RigidBody, open_mocap
from hil.sources.ulog import read_ulg

__all__ = [
    "BodyIds",
    "Column",
    "CsvParams",
    "LogBody",
    "MavlinkDecoder",
    "MavlinkSource",
    "MocapParams",
    "Recorded",
    "RigidBody",
    "Source",
    "open_mocap",
    "read_bin",
    "read_csv",
    "read_tlog",
    "read_ulg",
]
