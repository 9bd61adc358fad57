"""The recording of a diagnosis for the rerun viewer: measured and simulated paths of each flight,
without and with the selected effects.
"""

from collections.abc import Sequence
from pathlib import Path

import numpy as np
import rerun as rr
from numpy import ndarray

from visthrow.diagnose.models.model_interface import Window
from visthrow.diagnose.reporting.pictures import compute_residuals
from visthrow.diagnose.select.result import Diagnosis
from visthrow.logs.flightlog import FlightLog
from visthrow.view import style
from visthrow.view.rerun_view import colour_code, open_recording

TIMELINE = "flight_time"
PATHS = ("pos_w", "payload_pos_w")  # channels that are drawn in space


def write(path: str | Path, diagnosis: Diagnosis, logs: Sequence[FlightLog]) -> None:
    """Write a ``.rrd`` file with the measured paths of each flight, the paths simulated without and
    with the selected effects, and all residuals over time.

    ``logs``: in the order of the model's flight numbers; where stamps do not match, only residuals
    are written. Raises StorageError: the file cannot be written.
    """
    work = diagnosis.work
    with open_recording(path) as stream:
        stream.log("", rr.ViewCoordinates.RIGHT_HAND_Z_UP, static=True)
        for before, after in zip(work.before.windows, work.after.windows):
            log = logs[before.flight] if before.flight < len(logs) else None
            for c, name in enumerate(work.problem.model.channels):
                _channel(stream, name, c, before, after, work.after.noise, log)


def _channel(
    stream, name: str, channel: int, before: Window, after: Window, noise, log: FlightLog | None
) -> None:
    rows = np.flatnonzero(before.channel == channel)
    time = before.time[rows]
    width = np.count_nonzero(time == time[:1])  # components of a sample are adjacent
    if not width or len(rows) % width:
        return
    stamps = time[::width]
    old, new = (compute_residuals(w, noise)[rows].reshape(-1, width) for w in (before, after))
    home = f"flight_{before.flight:02d}"
    for values, label, colour in ((old, "before", style.BEFORE), (new, "after", style.AFTER)):
        entity = f"{home}/residual/{name}/{label}"
        look = rr.SeriesPoints(colors=[colour_code(colour)] * width, marker_sizes=[1.5] * width)
        stream.log(entity, look, static=True)
        scalars = np.ascontiguousarray(values, dtype=float)
        _send(stream, entity, stamps, rr.Scalars.columns(scalars=scalars))
    if name not in PATHS or log is None or name not in log or width != 3:
        return
    measured = log[name]
    index = np.clip(np.searchsorted(measured.time, stamps - 1e-9), 0, len(measured.time) - 1)
    if np.abs(measured.time[index] - stamps).max() > 1e-6:
        return
    place = measured.values[index]
    _path(stream, f"{home}/{name}/measured", stamps, place, style.INK)
    _path(stream, f"{home}/{name}/before", stamps, place - old, style.BEFORE)
    _path(stream, f"{home}/{name}/after", stamps, place - new, style.AFTER)


def _send(stream, entity: str, time: ndarray, columns) -> None:
    """Send columns that have a row for each time [s]."""
    stream.send_columns(entity, [rr.TimeColumn(TIMELINE, duration=time)], columns)


def _path(stream, entity: str, time: ndarray, points: ndarray, colour: str) -> None:
    points = points.astype(np.float32)
    look = {"colors": [colour_code(colour)]}
    stream.log(entity, rr.Points3D.from_fields(radii=0.006, **look), static=True)
    _send(stream, entity, time, rr.Points3D.columns(positions=points))
    whole = rr.LineStrips3D([points], radii=0.0015, **look)
    stream.log(f"{entity}/window_{time[0]:.2f}", whole, static=True)
