"""Reading of log files of any format into :class:`visthrow.logs.flightlog.FlightLog`."""

import re
from collections.abc import Sequence
from fnmatch import fnmatchcase
from itertools import takewhile
from pathlib import Path

import numpy as np

from visthrow.common.errors import LogError, suggest
from visthrow.logs.flightlog import FlightLog
from visthrow.logs.mapping import TableMap

BLACKBOX = (".bbl", ".bfl", ".bf")
"""Extensions of Betaflight's logs; the last is that of its software in the loop."""
AUTOPILOTS = (".ulg", ".bin", ".tlog")
TABLES = (".csv", ".csv.gz", ".csv.xz", ".tsv", ".txt", ".parquet")
SELF_DESCRIBING = (".npz", *BLACKBOX, *AUTOPILOTS)
"""Extensions of logs that describe their own contents and need no mapping."""
RUN_LOG = "flight.npz"
"""Flight log in the folder of a run of ``visthrow hil``; written if no throw was flown and
``--bare`` was not given.
"""
RUN_TICKS = "ticks.jsonl"
"""File of a run's ticks, from which the flight log is made."""
BAG = "metadata.yaml"
"""File that marks the folder of a ROS 2 bag."""


def read(path: str | Path, mapping: TableMap | None = None) -> list[FlightLog]:
    """Read a file or a folder into flight logs; a file may hold several.

    Raises LogError: the file cannot be read, or a table needs a mapping.

    Args:
        path: A file, or a folder with a ``flight.npz``, other logs or tables. ``stand.csv:a1_*``
            selects the logs in a file whose part matches the pattern; ``LOG00001.BFL+mocap.csv``
            joins logs of one flight.
        mapping: Of a table's columns; our own exports and decoded blackbox logs need none.
    """
    from visthrow.logs.readers.autopilot_logs import choose_converted_tables, log_of_autopilot

    path, ending = Path(path), Path(path).suffix.lower()
    if path.is_dir() and not (path / BAG).is_file():
        return _read_folder(path, mapping)
    if not path.exists():
        return _read_named(path, mapping)
    _refuse_pointer(path)
    if ending == ".npz":
        log = FlightLog.load(path)
        log.meta.setdefault("source", str(path))
        return [log]
    if ending in BLACKBOX:
        from visthrow.logs.readers.blackbox.channels import logs_of_blackbox

        return logs_of_blackbox(path)
    if ending in AUTOPILOTS or (mapping is None and choose_converted_tables([path])):
        return [log_of_autopilot(path)]
    return _read_table(path, mapping)


def read_all(paths: Sequence[str | Path], mapping: TableMap | None = None) -> list[FlightLog]:
    """Read several files; see :func:`read`."""
    return [log for path in paths for log in read(path, mapping)]


def takes_mapping(path: str | Path) -> bool:
    """Return whether :func:`read` uses a mapping of columns for a path: for a table, or for joined
    logs with a table among them.
    """
    parts = [str(path)] if Path(path).exists() else str(path).split("+")
    files = [Path(part if Path(part).exists() else part.rpartition(":")[0]) for part in parts]
    return not all(map(_describes_itself, files))


def _describes_itself(path: Path) -> bool:
    """Return whether a file or folder needs no mapping."""
    from visthrow.logs.readers.autopilot_logs import choose_converted_tables

    if (path / BAG).is_file():
        return False
    if path.is_dir():
        return bool(choose_converted_tables(path.iterdir())) or not _tables_in(path)
    return path.suffix.lower() in SELF_DESCRIBING or bool(choose_converted_tables([path]))


def _read_named(path: Path, mapping: TableMap | None) -> list[FlightLog]:
    """Read a path that is no file: logs of one flight joined by ``+``, or ``FILE:PATTERN``, the
    parts of a file.
    """
    file, _, pattern = str(path).rpartition(":")
    first, *further = str(path).split("+")
    if further and Path(first).exists():
        from visthrow.logs.joining import join

        groups = [read(part, mapping) for part in (first, *further)]
        for part, logs in zip((first, *further), groups):
            if len(logs) != 1:
                raise LogError(
                    f"{part}: holds {len(logs)} logs; joining needs one per file: FILE:PART"
                )
        return [join([log for logs in groups for log in logs])]
    if Path(file).is_file():
        logs = read(file, mapping)
        names = [str(log.meta.get("part", "")) for log in logs]
        chosen = [log for log, name in zip(logs, names) if fnmatchcase(name, pattern)]
        if not chosen:
            raise LogError(
                f"{file}: no part '{pattern}' among {len(names)}; {suggest(pattern, names)}"
            )
        return chosen
    raise _make_missing_error(path)


def _refuse_pointer(path: Path) -> None:
    """Raise LogError if a file is a pointer of Git LFS."""
    if path.is_file():
        with path.open("rb") as file:
            if file.read(23) == b"version https://git-lfs":
                raise LogError(f"{path}: a pointer of Git LFS; `git lfs pull` fetches the log")


def _make_missing_error(path: Path) -> LogError:
    folder = path if path.is_dir() else path.parent
    siblings = sorted(p.name for p in folder.iterdir()) if folder.is_dir() else []
    actual = "a folder, expected a file" if path.is_dir() else "no such file"
    return LogError(f"{path}: {actual}; in that folder: {', '.join(siblings[:20]) or 'nothing'}")


def _read_folder(path: Path, mapping: TableMap | None) -> list[FlightLog]:
    from visthrow.logs.readers.autopilot_logs import choose_converted_tables, log_of_autopilot

    if (path / RUN_LOG).is_file():
        return read(path / RUN_LOG)
    logs = sorted(p for p in path.glob("*.npz") if p.name != "policy.npz")
    if logs:
        return read_all(logs)
    if mapping is None and (tables := choose_converted_tables(sorted(path.iterdir()))):
        return [log_of_autopilot(table) for table in tables]
    if _tables_in(path):
        return _read_table(path, mapping)
    is_run = (path / RUN_TICKS).is_file()
    expected = f"visthrow hil view {path} writes them" if is_run else "name the files themselves"
    raise LogError(f"{path}: a folder without {RUN_LOG}, other .npz logs or tables; {expected}")


def _tables_in(folder: Path) -> list[Path]:
    from visthrow.logs.readers.recordings import READERS

    endings = (*TABLES, *READERS)
    return sorted(p for p in folder.iterdir() if p.name.lower().endswith(endings))


def _table_of_folder(folder: Path) -> dict[str, np.ndarray]:
    """Return the columns of all tables in a folder, named ``TOPIC:COLUMN`` as in a recording.

    A topic is the file's name without the prefix that all files share."""
    from visthrow.logs.readers.table_to_log import Columns

    files = _tables_in(folder)
    letters = takewhile(lambda column: len(set(column)) == 1, zip(*(file.name for file in files)))
    prefix = re.sub("[A-Za-z0-9]*$", "", "".join(column[0] for column in letters))
    columns = Columns()
    for file in files:
        topic = file.name.removeprefix(prefix).partition(".")[0]
        try:
            table = table_of(file)
        except LogError as error:
            columns.left_out.append(str(error))
            continue
        columns |= {f"{topic}:{name}": cells for name, cells in table.items()}
        columns.left_out += [f"{topic}:{part}" for part in getattr(table, "left_out", ())]
    if not columns:
        raise LogError(f"{folder}: no table among its files: {'; '.join(columns.left_out)}")
    return columns


def table_of(path: str | Path) -> dict[str, np.ndarray]:
    """Return the columns of a table, by name.

    Raises LogError: the table cannot be read, or its format needs no mapping.
    """
    from visthrow.logs.readers import recordings, table_to_log

    path, ending = Path(path), Path(path).suffix.lower()
    bag = (path / BAG).is_file()
    if ending in SELF_DESCRIBING and not bag:
        raise LogError(
            f"{path}: describes its own contents and needs no mapping; look at it with: visthrow"
            f" diagnose check {path}"
        )
    if path.is_dir() and not bag and _tables_in(path):
        return _table_of_folder(path)
    if not path.is_file() and not bag:
        parts = str(path).split("+")
        if len(parts) > 1 and Path(parts[0]).exists():
            raise LogError(
                f"{path}: {len(parts)} files; expected one: a mapping describes one table. `check`"
                " and `explain` join logs, and a folder of tables is one recording"
            )
        raise _make_missing_error(path)
    _refuse_pointer(path)
    if path.name.lower().endswith(TABLES):
        return table_to_log.read_table(path)
    if bag or ending in recordings.READERS or recordings.is_card(path):
        return recordings.read_recording(path)
    if _is_text(path):  # .tum, .dat, .log, .asc, ...
        return table_to_log.read_table(path)
    of_tables = ", ".join((*TABLES, *recordings.READERS, *SELF_DESCRIBING))
    raise LogError(
        f"{path}: ending '{path.suffix}', and not text; expected one of {of_tables}, or a table in"
        " text"
    )


def _is_text(path: Path) -> bool:
    with path.open("rb") as file:
        return b"\0" not in file.read(4096)


def _read_table(path: Path, mapping: TableMap | None) -> list[FlightLog]:
    from visthrow.logs.readers import table_to_log
    from visthrow.logs.readers.blackbox import channels

    columns = table_of(path)
    if mapping is not None:
        return table_to_log.logs_of(columns, mapping, str(path))
    if channels.is_decoded(columns):
        return [channels.log_of_decoded(columns, path)]
    if (exported := table_to_log.log_of_export(columns, path)) is not None:
        return [exported]
    names = ", ".join(list(columns)[:12])
    raise LogError(
        f"{path}: a table with the columns {names}, ...: it needs a mapping; give --config NAME"
        " (configs/diagnose), or let `visthrow diagnose map FILE --out mine.toml` propose one"
    )
