"""Record the progress of a training run: printed lines, and one CSV row for each iteration."""

import csv
import io
import math
import time
from datetime import timedelta
from pathlib import Path
from types import TracebackType
from typing import TextIO

from visthrow.common.storage import atomic_write
from visthrow.task.measurement import Throws

COLUMNS = (
    "iteration",
    "released",
    "landing_error",
    "duration",
    "episodes",
    "value",
    "surrogate",
    "entropy",
    "learning_rate",
    "rollout_s",
    "learning_s",
    "wall_s",
    "error_2m",
    "duration_2m",
    "landed_2m",
)

PRINT_PERIOD = 25  # iterations between two lines


class TrainLog:
    """The log of one run, used as a context manager.

    A resumed run keeps the rows up to its checkpoint. It drops later rows and an incomplete last
    row, because it repeats these iterations."""

    def __init__(
        self, path: Path, samples: int, last: int, done: int = 0, minutes: float | None = None
    ):
        """Open the CSV file.

        Args:
            path: the CSV file.
            samples: environment steps in each iteration.
            last: the run's last iteration.
            done: iterations that a resumed run had finished before.
            minutes: limit of the run's duration; None if unlimited.
        """
        self.samples = samples
        self.last = last
        self.done = done
        self.minutes = minutes
        rows = _rows(path, done) if done and path.exists() else []
        text = io.StringIO()
        writer = _writer(text)
        writer.writeheader()
        writer.writerows(rows)
        atomic_write(path, text.getvalue())
        self._before = float(rows[-1]["wall_s"]) if rows else 0.0
        self._start = time.perf_counter()
        self._file = path.open("a", newline="", encoding="utf-8")
        self._writer = _writer(self._file)

    def __enter__(self) -> "TrainLog":
        return self

    def __exit__(
        self, kind: type | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        try:
            self._file.close()
        except OSError:
            if error is None:
                raise

    def row(self, figures: dict, throws: Throws | None = None) -> None:
        """Write one iteration's figures and, if it was evaluated, the results of its throws.

        Raises OSError: the disk is full.
        """
        elapsed = time.perf_counter() - self._start
        figures = figures | {"wall_s": self._before + elapsed}
        if throws is not None:
            result = throws.summary()  # without an error if no throw landed
            figures |= {
                "error_2m": result.get("error_mean", math.nan),
                "duration_2m": result.get("duration_mean", math.nan),
                "landed_2m": result["success"],
            }
        self._writer.writerow(figures)
        self._file.flush()
        speed = self.samples / (figures["rollout_s"] + figures["learning_s"]) / 1e6
        remaining = self._estimate_remaining(figures["iteration"], elapsed)
        text = (
            f"iteration {figures['iteration']}/{self.last}  {speed:.2f} M steps/s  released"
            f" {100 * figures['released']:.0f} %  landing error {figures['landing_error']:.3f} m "
            f" {timedelta(seconds=round(figures['wall_s']))},"
            f" {timedelta(seconds=round(remaining))} left"
        )
        if throws is not None:
            text += (
                f"  at 2.0 m: {figures['error_2m']:.4f} m, {figures['duration_2m']:.3f} s,"
                f" landed {100 * figures['landed_2m']:.1f} %"
            )
        if throws is not None or figures["iteration"] % PRINT_PERIOD == 0:
            print(text, flush=True)

    def _estimate_remaining(self, iteration: int, elapsed: float) -> float:
        """Return the time to the last iteration, at the speed so far, or to the limit [s]."""
        remaining = (self.last - iteration) * elapsed / max(iteration - self.done, 1)
        if self.minutes is None:
            return remaining
        return max(min(remaining, 60.0 * self.minutes - elapsed), 0.0)


def _writer(file: TextIO) -> csv.DictWriter:
    """Return a writer of the log's columns."""
    return csv.DictWriter(file, COLUMNS, extrasaction="ignore", lineterminator="\n")


def _rows(path: Path, done: int) -> list[dict]:
    """Return the complete rows of a log up to an iteration."""
    rows = []
    with path.open(newline="", encoding="utf-8") as file:
        for row in csv.DictReader(file):
            iteration = row.get("iteration") or ""
            whole = iteration.isdigit() and row.get(COLUMNS[-1]) is not None
            if whole and int(iteration) <= done:
                rows.append(row)
    return rows
