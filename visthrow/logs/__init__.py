"""Logs of any kind, opened by their ending, into :class:`visthrow.logs.flightlog.FlightLog`."""

from collections.abc import Sequence
from fnmatch import fnmatchcase
from pathlib import Path

import numpy as np

from visthrow.common.errors import LogError, suggest
from visthrow.logs.flightlog import FlightLog
from visthrow.logs.mapping import TableMap

BLACKBOX = (".bbl", ".bfl", ".bf")
"""Of Betaflight; the last is that of its software in the loop."""
ENDINGS = (".npz", ".csv", ".csv.gz", ".csv.xz", ".txt", ".parquet", *BLACKBOX, ".ulg", ".bin", ".tlog")
RECORDINGS = (".mat", ".h5", ".hdf5", ".bag", ".db3", ".mcap")
"""Endings of other tools' recordings; the Crazyflie's card names its files without an ending."""
TABLES = (".csv", ".csv.gz", ".csv.xz", ".txt", ".parquet")
RUN_LOG = "flight.npz"
"""In the folder of a run of ``visthrow hil``: its flight log."""


def read(path: str | Path, mapping: TableMap | None = None) -> list[FlightLog]:
    """Read a file, or the folder of a run, into flight logs; a file may hold several.

    Args:
        path: Of one of :data:`ENDINGS`, or a folder that holds a ``flight.npz``. ``stand.csv:a1_*`` takes of the logs in a
            file those whose part fits the pattern; ``LOG00001.BFL+mocap.csv`` joins logs of one flight.
        mapping: Of a table's columns; not needed for our own exports and decoded blackbox logs.

    Raises:
        LogError: It cannot be read, or a table needs a mapping.
    """
    path = Path(path)
    file, colon, pattern = str(path).rpartition(":")
    if "+" in str(path) and not path.exists() and Path(str(path).split("+")[0]).exists():
        return [_joined(str(path), mapping)]
    if colon and not path.exists() and Path(file).is_file():
        return _parts(read(file, mapping), file, pattern)
    if path.is_dir():
        return _of_folder(path)
    name = path.name.lower()
    if not path.exists():
        near = sorted(p.name for p in path.parent.iterdir()) if path.parent.is_dir() else []
        raise LogError(f"{path}: no such file; in that folder: {', '.join(near[:20]) or 'nothing'}")
    if name.endswith(TABLES):
        logs = _of_table(path, mapping)
    elif name.endswith(BLACKBOX):
        from visthrow.logs.readers.blackbox.channels import logs_of_blackbox

        logs = logs_of_blackbox(path)
    elif name.endswith((".ulg", ".bin", ".tlog")):
        from visthrow.logs.readers.autopilot import log_of_autopilot

        logs = [log_of_autopilot(path)]
    elif name.endswith(".npz"):
        log = FlightLog.load(path)
        log.meta.setdefault("source", str(path))
        logs = [log]
    elif _is_recording(path):
        logs = _of_table(path, mapping)
    else:
        raise LogError(f"{path}: ending '{path.suffix}'; expected one of {', '.join((*ENDINGS, *RECORDINGS))}")
    return logs


def read_all(paths: Sequence[str | Path], mapping: TableMap | None = None) -> list[FlightLog]:
    """Read several files; see :func:`read`."""
    return [log for path in paths for log in read(path, mapping)]


def _joined(paths: str, mapping: TableMap | None) -> FlightLog:
    from visthrow.logs.joining import join

    logs = []
    for path in paths.split("+"):
        found = read(path, mapping)
        if len(found) != 1:
            raise LogError(f"{path}: {len(found)} logs in it; joining needs one of each, named as FILE:PART")
        logs += found
    return join(logs)


def _parts(logs: list[FlightLog], file: str, pattern: str) -> list[FlightLog]:
    names = [str(log.meta.get("part", "")) for log in logs]
    chosen = [log for log, name in zip(logs, names) if fnmatchcase(name, pattern)]
    if not chosen:
        raise LogError(f"{file}: no part '{pattern}' among {len(names)}; {suggest(pattern, names)}")
    return chosen


def _of_folder(path: Path) -> list[FlightLog]:
    if (path / RUN_LOG).is_file():
        return read(path / RUN_LOG)
    logs = sorted(p for p in path.glob("*.npz") if p.name != "policy.npz")
    if not logs:
        raise LogError(f"{path}: a folder without {RUN_LOG} or other .npz logs; name the files themselves")
    return read_all(logs)


def table_of(path: str | Path) -> dict[str, np.ndarray]:
    """Return the columns of a table, by name.

    Raises:
        LogError: It cannot be read, or its format needs no mapping.
    """
    from visthrow.logs.readers import recordings, table

    path = Path(path)
    if path.name.lower().endswith(TABLES):
        return table.read_table(path)
    if path.suffix.lower() not in ENDINGS and not path.is_file():
        raise LogError(f"{path}: no such file")
    if not _is_recording(path):
        known = ", ".join((*TABLES, *RECORDINGS))
        raise LogError(f"{path}: ending '{path.suffix}'; a mapping is for {known}; other logs say what they hold")
    return recordings.read_recording(path)


def _is_recording(path: Path) -> bool:
    from visthrow.logs.readers.recordings import is_card

    return path.suffix.lower() in RECORDINGS or (path.is_file() and path.suffix.lower() not in ENDINGS and is_card(path))


def _of_table(path: Path, mapping: TableMap | None) -> list[FlightLog]:
    from visthrow.logs.readers import table
    from visthrow.logs.readers.blackbox import channels

    columns = table_of(path)
    if mapping is not None:
        return table.logs_of(columns, mapping, str(path))
    if channels.is_decoded(columns):
        return [channels.log_of_decoded(columns, path)]
    if table.is_export(columns):
        log = table.log_of_export(columns, str(path))
        if path.suffix == ".parquet":
            log.meta.update(table.metadata_of(path))
        return [log]
    names = ", ".join(list(columns)[:12])
    raise LogError(f"{path}: a table with the columns {names}, ...: it needs a mapping; give --config NAME (configs/diagnose)")
