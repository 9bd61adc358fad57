"""Export of a flight log to tables that other programs read: CSV and parquet.

There is a row for each time stamp of any channel and a column for each component. A cell is empty
if the channel has no valid sample at that time. Column names state unit and frame:
``pos_w[0] [m, world]``."""

import csv
import io
import json
from pathlib import Path

import numpy as np

from visthrow.common.errors import LogError
from visthrow.common.storage import atomic_write
from visthrow.logs.flightlog import FlightLog

FORMATS = {".csv": ("csv", ""), ".parquet": ("pyarrow", "view")}
"""File extension -> the module that writes it, and the extra that installs the module."""


def export(log: FlightLog, path: str | Path) -> None:
    """Write a flight log as ``.csv`` or ``.parquet``, by the extension of the path; parquet also
    holds the metadata.

    Raises LogError for another extension; StorageError if the file cannot be written.
    """
    ending = Path(path).suffix
    if ending == ".csv":
        atomic_write(path, _csv(log))
    elif ending == ".parquet":
        atomic_write(path, _parquet(log))
    else:
        raise LogError(f"{path}: ending '{ending}'; expected one of {', '.join(FORMATS)}")


def columns(log: FlightLog) -> dict[str, np.ma.MaskedArray]:
    """Arrange all channels on the union of their time stamps.

    Returns column name -> values, shape (N,), masked where there is no valid sample; ``time [s]``
    is first."""
    stamps = [channel.time for channel in log.channels.values()]
    time = np.unique(np.concatenate(stamps)) if stamps else np.empty(0)
    table = {"time [s]": np.ma.array(time)}
    for name, channel in log.channels.items():
        rows = np.searchsorted(time, channel.time)
        place = channel.unit if channel.frame == "none" else f"{channel.unit}, {channel.frame}"
        for index in np.ndindex(channel.values.shape[1:]):
            column = np.ma.masked_all(len(time), dtype=channel.values.dtype)
            samples = channel.values[(slice(None), *index)]
            column[rows[channel.valid]] = samples[channel.valid]
            label = f"{name}[{','.join(map(str, index))}]" if index else name
            table[f"{label} [{place}]"] = column
    return table


def _csv(log: FlightLog) -> str:
    table = columns(log)
    text = io.StringIO()
    writer = csv.writer(text, lineterminator="\n")
    writer.writerow(table)
    cells = [
        ["" if value is None else value for value in column.tolist()] for column in table.values()
    ]
    writer.writerows(zip(*cells))
    return text.getvalue()


def _parquet(log: FlightLog) -> bytes:
    import pyarrow as pa
    import pyarrow.parquet as pq

    table = columns(log)
    arrays = {
        name: pa.array(column.data, mask=np.ma.getmaskarray(column))
        for name, column in table.items()
    }
    metadata = {"visthrow": json.dumps(log.meta)}
    buffer = io.BytesIO()
    pq.write_table(pa.table(arrays).replace_schema_metadata(metadata), buffer)
    return buffer.getvalue()
