"""The recording of a diagnosis for the rerun viewer: measured, simulated before and simulated after, flight by flight."""

import tempfile
from collections.abc import Sequence
from pathlib import Path

import numpy as np

from visthrow.common import style
from visthrow.common.errors import StorageError
from visthrow.common.storage import atomic_write
from visthrow.diagnose.models.interface import Window
from visthrow.diagnose.reporting.pictures import AFTER, BEFORE, left_over
from visthrow.diagnose.select.result import Diagnosis
from visthrow.logs.flightlog import FlightLog

TIMELINE = "flight_time"
PATHS = ("pos_w", "payload_pos_w")
"""Channels that are drawn in space."""


def write(path: str | Path, diagnosis: Diagnosis, logs: Sequence[FlightLog]) -> None:
    """Write a ``.rrd``: for each flight the measured paths, the ghosts of both models, and all residuals over time.

    Args:
        path: The file.
        diagnosis: with its ``work``.
        logs: in the order in which the model numbers them; a model that numbers them otherwise gets residuals alone.

    Raises:
        StorageError: The place cannot be written.
    """
    import rerun as rr

    stream = rr.RecordingStream("visthrow_diagnose", recording_id=None)
    work = diagnosis.work
    with tempfile.TemporaryDirectory() as folder:
        whole = Path(folder) / "diagnosis.rrd"
        try:
            stream.save(whole)
            stream.log("", rr.ViewCoordinates.RIGHT_HAND_Z_UP, static=True)
            for before, after in zip(work.before.windows, work.after.windows):
                log = logs[before.flight] if before.flight < len(logs) else None
                for c, name in enumerate(work.problem.model.channels):
                    _channel(stream, name, c, before, after, work.after.noise, log)
            stream.flush()
            stream.disconnect()
            content = whole.read_bytes()
        except OSError as error:
            raise StorageError(f"cannot write the recording: {error}") from error
    atomic_write(path, content)


def _channel(stream, name: str, channel: int, before: Window, after: Window, noise, log: FlightLog | None) -> None:
    rows = np.flatnonzero(before.channel == channel)
    if not len(rows):
        return
    time = before.time[rows]
    width = int(np.sum(time == time[0]))  # components of a sample stand together
    if len(rows) % width:
        return
    at = time[::width]
    old, new = (left_over(w, noise)[rows].reshape(-1, width) for w in (before, after))
    home = f"flight_{before.flight:02d}"
    for values, label, colour in ((old, "before", BEFORE), (new, "after", AFTER)):
        _series(stream, f"{home}/residual/{name}/{label}", at, values, colour)
    if name not in PATHS or log is None or name not in log or width != 3:
        return
    measured = log[name]
    index = np.clip(np.searchsorted(measured.time, at - 1e-9), 0, len(measured.time) - 1)
    if np.abs(measured.time[index] - at).max() > 1e-6:
        return
    place = measured.values[index]
    for points, label, colour in ((place, "measured", style.INK), (place - old, "before", BEFORE), (place - new, "after", AFTER)):
        _path(stream, f"{home}/{name}/{label}", at, points, colour)


def _series(stream, entity: str, time: np.ndarray, values: np.ndarray, colour: str) -> None:
    import rerun as rr

    count = values.shape[1]
    stream.log(entity, rr.SeriesPoints(colors=[_rgb(colour)] * count, marker_sizes=[1.5] * count), static=True)
    column = rr.TimeColumn(TIMELINE, duration=time)
    stream.send_columns(entity, [column], rr.Scalars.columns(scalars=np.ascontiguousarray(values, dtype=float)))


def _rgb(colour: str) -> list[int]:
    return [int(colour[i : i + 2], 16) for i in (1, 3, 5)]


def _path(stream, entity: str, time: np.ndarray, points: np.ndarray, colour: str) -> None:
    import rerun as rr

    code = _rgb(colour)
    stream.log(entity, rr.Points3D.from_fields(radii=0.006, colors=[code]), static=True)
    column = rr.TimeColumn(TIMELINE, duration=time)
    stream.send_columns(entity, [column], rr.Points3D.columns(positions=points.astype(np.float32)))
    whole = rr.LineStrips3D([points.astype(np.float32)], radii=0.0015, colors=[code])
    stream.log(f"{entity}/window_{time[0]:.2f}", whole, static=True)
