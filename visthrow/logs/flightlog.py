"""The record of one flight: channels, each with its own time stamps, and metadata.

``flightlog.toml`` lists the channels of standard names (`STANDARD_CHANNELS`). Simulated throws,
throws of the reference plant and flights of a real vehicle use the same record, so every tool reads
all of them. Onboard-safe (numpy only)."""

from collections.abc import Mapping
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any

import numpy as np
from numpy import ndarray

from visthrow.common.errors import LogError, suggest
from visthrow.common.storage import from_json_array, json_array, loadz, savez
from visthrow.common.toml_text import tables_beside
from visthrow.logs.samples import Samples

FORMAT_VERSION = 1
FRAMES = ("world", "body", "camera", "image", "mocap", "none")


@dataclass(frozen=True)
class ChannelSpec:
    """Unit, frame, shape and meaning of a channel of a standard name."""

    unit: str
    frame: str  # one of FRAMES
    shape: tuple[int | None, ...]  # of one sample; None: any length
    meaning: str


def _standard_channels() -> dict[str, ChannelSpec]:
    rows = tables_beside(__file__)
    for row in rows.values():
        row["shape"] = tuple(None if size < 0 else size for size in row["shape"])
    return {name: ChannelSpec(**row) for name, row in rows.items()}


STANDARD_CHANNELS = _standard_channels()
"""Standard name -> specification of the channel. Channels of other names may hold anything."""


@dataclass(frozen=True)
class Channel:
    """Samples of one quantity.

    Raises LogError if lengths differ, time does not increase, or a valid sample is not finite.
    """

    time: ndarray  # strictly increasing [s], shape (T,), float64
    values: ndarray  # shape (T, ...)
    unit: str
    frame: str = "none"
    valid: ndarray | None = None  # shape (T,), bool; None becomes all true

    def __post_init__(self) -> None:
        time = np.asarray(self.time, dtype=np.float64)
        values = np.asarray(self.values)
        if self.valid is None:
            valid = np.ones(len(time), dtype=bool)
        else:
            valid = np.asarray(self.valid, dtype=bool)
        if (
            time.ndim != 1
            or values.ndim < 1
            or valid.shape != time.shape
            or len(values) != len(time)
        ):
            raise LogError(
                f"got time {time.shape}, values {values.shape}, validity {valid.shape}; expected"
                " (T,), (T, ...), (T,)"
            )
        if not np.all(np.isfinite(time)):
            raise LogError(f"time stamp {int(np.argmin(np.isfinite(time)))} is not finite")
        late = np.flatnonzero(np.diff(time) <= 0.0)
        if len(late):
            i = int(late[0])
            raise LogError(
                f"time must increase; sample {i} is at {time[i]} s, sample {i + 1} at"
                f" {time[i + 1]} s"
            )
        if values.dtype.kind not in "bif":
            raise LogError(f"values are of type {values.dtype}; expected numbers or bools")
        if values.dtype.kind == "f" and not np.all(np.isfinite(values[valid])):
            raise LogError("a sample marked valid is not finite")
        if self.frame not in FRAMES:
            raise LogError(f"frame '{self.frame}'; {suggest(self.frame, FRAMES)}")
        for name, array in (("time", time), ("values", values), ("valid", valid)):
            object.__setattr__(self, name, array)

    def only(self, keep: ndarray) -> "Channel":
        """Return the channel with a part of its samples; ``keep``: shape (T,), bool."""
        return replace(
            self, time=self.time[keep], values=self.values[keep], valid=np.asarray(self.valid)[keep]
        )

    @property
    def rows(self) -> ndarray:
        """All samples as rows of numbers, float64, shape (T, components)."""
        width = np.prod(self.values.shape[1:], dtype=int)
        return self.values.reshape(len(self.time), width).astype(float)

    def at(self, time: float) -> ndarray:
        """Interpolate the value at a time [s] linearly."""
        values = [np.interp(time, self.time, column) for column in self.rows.T]
        return np.array(values).reshape(self.values.shape[1:])

    def samples(self) -> Samples:
        """Return the valid samples, float64."""
        valid = np.asarray(self.valid)
        return Samples(self.time[valid], self.rows[valid])

    def hold(self, time: ndarray) -> ndarray:
        """Return the last valid sample at or before each time; the first valid one if there is none
        before.

        Raises LogError if no sample is valid.

        Args:
            time: [s], shape (N,).

        Returns:
            Values, shape (N, ...).
        """
        valid_rows = np.flatnonzero(np.asarray(self.valid))
        if not len(valid_rows):
            raise LogError("no sample of the channel is valid")
        rows = (
            np.searchsorted(self.time[valid_rows], np.asarray(time, dtype=float), side="right") - 1
        )
        return self.values[valid_rows[np.maximum(rows, 0)]]


@dataclass(frozen=True)
class FlightLog:
    """All channels of a flight, and metadata: goal, plant, policy, config, provenance.

    Raises LogError if a channel of a standard name has another unit, frame or shape than the
    standard says."""

    channels: dict[str, Channel]
    meta: dict[str, Any] = field(default_factory=dict)

    def __post_init__(self) -> None:
        for name, channel in self.channels.items():
            spec = STANDARD_CHANNELS.get(name)
            if spec is None:
                continue
            actual = (channel.unit, channel.frame)
            expected = (spec.unit, spec.frame)
            if actual != expected:
                raise LogError(
                    f"channel '{name}' is in unit and frame {actual}; expected {expected}"
                )
            shape = channel.values.shape[1:]
            fits = len(shape) == len(spec.shape) and all(
                b in (None, a) for a, b in zip(shape, spec.shape)
            )
            if not fits:
                raise LogError(
                    f"channel '{name}' has samples of shape {shape}; expected {spec.shape}"
                )

    def __getitem__(self, name: str) -> Channel:
        """Return a channel.

        Raises LogError if there is none of that name; the message lists what exists.
        """
        if name not in self.channels:
            raise LogError(f"no channel '{name}'; {suggest(name, self.channels)}")
        return self.channels[name]

    def __contains__(self, name: str) -> bool:
        return name in self.channels

    def samples(self, name: str, fewest: int = 50) -> Samples | None:
        """Return the valid samples of a channel; None if there are less than ``fewest``."""
        if name not in self:
            return None
        samples = self[name].samples()
        return samples if len(samples.time) >= fewest else None

    def notes(self, name: str) -> dict[str, Any]:
        """Return the reader's notes on a channel."""
        notes: dict[str, Any] = self.meta.get("ingest", {}).get(name, {})
        return notes

    def without_estimates(self) -> "FlightLog":
        """Return the log without channels that were computed from others (``estimated`` of the
        metadata names them).
        """
        left_out = self.meta.get("estimated", ())
        return FlightLog(
            {name: channel for name, channel in self.channels.items() if name not in left_out},
            self.meta,
        )

    def save(self, path: str | Path) -> None:
        """Write the log atomically as an ``.npz`` without pickle.

        Raises LogError if the metadata cannot be written as JSON; StorageError if the file cannot
        be written."""
        units = {
            name: {"unit": channel.unit, "frame": channel.frame}
            for name, channel in self.channels.items()
        }
        try:
            arrays = {
                "header": json_array(
                    {"format_version": FORMAT_VERSION, "channels": units, "meta": self.meta}
                )
            }
        except (TypeError, ValueError) as error:
            raise LogError(f"the metadata cannot be written as JSON: {error}") from error
        for name, channel in self.channels.items():
            arrays |= {
                f"{name}/time": channel.time,
                f"{name}/values": channel.values,
                f"{name}/valid": np.asarray(channel.valid),
            }
        savez(path, arrays)

    @staticmethod
    def load(path: str | Path) -> "FlightLog":
        """Read a log.

        Raises LogError if the file is missing, truncated, of another version, incomplete or
        inconsistent.
        """
        arrays = loadz(path, LogError, "a flight log")
        try:
            header = from_json_array(arrays["header"])
            version = header["format_version"]
            units = header["channels"]
            meta = header["meta"]
            if version != FORMAT_VERSION:
                raise LogError(
                    f"format version {version}; this program reads version {FORMAT_VERSION}"
                )
            channels = {
                name: Channel(
                    arrays[f"{name}/time"],
                    arrays[f"{name}/values"],
                    quantity["unit"],
                    quantity["frame"],
                    arrays[f"{name}/valid"],
                )
                for name, quantity in units.items()
            }
            return FlightLog(channels, meta)
        except LogError as error:
            raise LogError(f"{path}: {error}") from error
        except (KeyError, TypeError, ValueError) as error:
            reason = f"no entry {error}" if isinstance(error, KeyError) else str(error)
            raise LogError(
                f"{path}: incomplete: {reason}; expected a flight log, it holds"
                f" {', '.join(sorted(arrays))}"
            ) from error


class FlightRecorder:
    """A recorder that collects copies of samples one by one and turns them into a ``FlightLog``."""

    def __init__(self, meta: Mapping[str, Any] | None = None):
        """Create a recorder without samples; ``meta``: metadata of the flight."""
        self.meta = dict(meta or {})
        self._samples: dict[str, list[tuple[float, ndarray, bool]]] = {}
        self._units: dict[str, tuple[str, str]] = {}

    def declare(self, name: str, unit: str, frame: str = "none") -> None:
        """Set unit and frame of a channel without a standard name."""
        self._units[name] = (unit, frame)

    def add(self, time: float, valid: bool = True, **values: Any) -> None:
        """Add one sample to each named channel.

        Raises LogError if a channel has neither a standard name nor been declared.

        Args:
            time: [s].
            valid: Whether these samples are valid.
            **values: One sample per channel: number, bool or array.
        """
        for name, value in values.items():
            if name not in self._units:
                if name not in STANDARD_CHANNELS:
                    raise LogError(
                        f"channel '{name}' was not declared; {suggest(name, STANDARD_CHANNELS)}"
                    )
                self._units[name] = (STANDARD_CHANNELS[name].unit, STANDARD_CHANNELS[name].frame)
            self._samples.setdefault(name, []).append((time, np.array(value), valid))

    def log(self) -> FlightLog:
        """Return the log of all samples so far.

        Raises LogError if samples of one channel differ in shape or do not increase in time; the
        message names the channel.
        """
        channels = {}
        for name, samples in self._samples.items():
            time, values, valid = zip(*samples)
            unit, frame = self._units[name]
            try:
                channels[name] = Channel(
                    np.array(time), np.stack(values), unit, frame, np.array(valid)
                )
            except (LogError, ValueError) as error:
                raise LogError(f"channel '{name}': {error}") from error
        return FlightLog(channels, dict(self.meta))
