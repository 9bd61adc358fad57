"""Sources of poses: MAVLink, .tlog and CSV behind one face, live and replayed alike.

A source hands on raw poses, in its own frames; `hil.frames` converts them.
"""

from hil.sources.base import Recorded, Source
from hil.sources.csv_file import Column, CsvParams, read_csv
from hil.sources.mavlink import BodyIds, MavlinkDecoder, MavlinkSource, read_tlog

__all__ = [
    "BodyIds",
    "Column",
    "CsvParams",
    "MavlinkDecoder",
    "MavlinkSource",
    "Recorded",
    "Source",
    "read_csv",
    "read_tlog",
]
