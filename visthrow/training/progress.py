"""Progress of a training run: a line on the terminal, a CSV row an iteration."""

import csv
import io
import sys
import time
from pathlib import Path
from types import TracebackType

from visthrow.common.storage import atomic_write

COLUMNS = (
    "iteration", "released", "landing_error", "duration", "episodes", "value", "surrogate", "entropy", "learning_rate",
    "rollout_s", "learning_s", "wall_s", "error_2m", "duration_2m",
)  # fmt: skip


class TrainLog:
    """Open log of one run, to be used as a context manager.

    A resumed run keeps the rows up to its checkpoint and drops later ones, a torn last row included: they are made again.
    """

    def __init__(self, path: Path, samples: int, last: int, done: int = 0):
        """Open the file.

        Args:
            path: of the CSV file.
            samples: environment steps an iteration.
            last: iteration that the run ends at.
            done: iterations that a resumed run has behind it.
        """
        self.samples, self.last, self.start = samples, last, time.perf_counter()
        rows = _rows(path, done) if done and path.exists() else []
        text = io.StringIO()
        writer = csv.DictWriter(text, COLUMNS, extrasaction="ignore", lineterminator="\n")
        writer.writeheader()
        writer.writerows(rows)
        atomic_write(path, text.getvalue())
        self._file = path.open("a", newline="", encoding="utf-8")
        self._writer = csv.DictWriter(self._file, COLUMNS, extrasaction="ignore", lineterminator="\n")

    def __enter__(self) -> "TrainLog":
        return self

    def __exit__(self, kind: type | None, error: BaseException | None, trace: TracebackType | None) -> None:
        try:
            self._file.close()
        except OSError:
            if error is None:
                raise

    def row(self, figures: dict) -> None:
        """Write one iteration's figures.

        Raises:
            OSError: the disk is full or gone.
        """
        wall = time.perf_counter() - self.start
        self._writer.writerow(figures | {"wall_s": wall})
        self._file.flush()
        speed = self.samples / (figures["rollout_s"] + figures["learning_s"]) / 1e6
        text = (
            f"iteration {figures['iteration']}/{self.last}  {speed:.2f} M steps/s  released {100 * figures['released']:.0f} %  "
            f"landing error {figures['landing_error']:.3f} m  {wall:.0f} s"
        )
        lead = "\r" if sys.stdout.isatty() else ""
        if "error_2m" in figures:
            print(f"{lead}{text}  at 2.0 m: {figures['error_2m']:.4f} m, {figures['duration_2m']:.3f} s", flush=True)
        elif lead:
            print(f"{lead}{text}   ", end="", flush=True)
        elif figures["iteration"] % 25 == 0:
            print(text, flush=True)


def _rows(path: Path, done: int) -> list[dict]:
    """Whole rows of a log up to an iteration."""
    with path.open(newline="", encoding="utf-8") as file:
        rows = [
            row
            for row in csv.DictReader(file)
            if (row.get("iteration") or "").isdigit() and row["duration_2m"] is not None
        ]
    return [row for row in rows if int(row["iteration"]) <= done]
