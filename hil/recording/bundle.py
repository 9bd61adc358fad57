"""One file of a run that ended other than well: all that replays it bit for bit, and a sentence on where it went wrong."""

import tempfile
import zipfile
import zlib
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

from hil.errors import RunError
from hil.poses.track import BodyState
from hil.recording.record import CONFIG, POLICY, POSES, PROVENANCE, SUMMARY, TICKS, require_run

PARTS = (CONFIG, POLICY, POSES, TICKS, SUMMARY, PROVENANCE)  # files of a bundle, beside the links' own records

RECORDS = ("*.tlog", "*.msp")

ENDING, MOST = ".zip", 2 << 30  # bytes that a bundle may unpack to; a run of an hour has a tenth of it


def pack(folder: str | Path) -> Path:
    """Write the bundle of a run beside its folder and return its path; raises `RunError` where that cannot be."""
    folder = Path(folder).resolve()
    require_run(folder)
    path = folder.with_name(folder.name + ENDING)
    found = [folder / name for name in PARTS if (folder / name).is_file()]
    found += sorted(file for pattern in RECORDS for file in folder.glob(pattern))
    part = path.with_name(f".{path.name}.tmp")
    try:
        with zipfile.ZipFile(part, "w", zipfile.ZIP_DEFLATED) as bundle:
            for file in found:
                bundle.write(file, file.name)
        part.replace(path)
    except OSError as error:
        part.unlink(missing_ok=True)
        raise RunError(f"{path}: cannot be written: {error.strerror}") from error
    return path


@contextmanager
def opened(path: str | Path) -> Iterator[Path]:
    """The folder of a run: the one that is named, or that of a bundle while it is looked at.

    Raises:
        RunError: a file that is no bundle, or one that unpacks to more than a run.
    """
    path = Path(path)
    if path.is_dir() or not path.exists():
        yield path
        return
    with tempfile.TemporaryDirectory() as folder:
        try:
            with zipfile.ZipFile(path) as bundle:
                entries = [entry for entry in bundle.infolist() if Path(entry.filename).name == entry.filename]
                if sum(entry.file_size for entry in entries) > MOST:
                    raise RunError(f"{path}: unpacks to more than {MOST >> 30} GiB; expected the bundle of a run")
                for entry in entries:
                    bundle.extract(entry, folder)
        except (zipfile.BadZipFile, zlib.error, RuntimeError, OSError) as error:  # RuntimeError: locked by a password, an unknown method
            raise RunError(f"{path}: {error}; expected a folder of a run, or the bundle of one") from error
        yield Path(folder)


def sentence(turn: dict[str, Any] | None, last: dict[str, Any] | None, cut: str | None) -> str:
    """Return where a run went wrong.

    Args:
        turn: the first tick in abort: ``time`` [s], ``state`` before it, ``since`` when that lasted [s], ``reason``, and ``vehicle``
            as it was seen. last: the last tick, in the same form, if any. cut: what is missing of the recording.
    """
    at = turn or (last if cut else None)
    if at is None:
        return "It did not go wrong." if last is None else f"It did not go wrong: it ended in {last['state']} ({last['reason']})."
    why = turn["reason"] if turn else "the recording ends"
    vehicle: BodyState | None = at["vehicle"]
    where = "had not been seen"
    if vehicle is not None:
        place, speed = ", ".join(f"{x:.2f}" for x in vehicle.pos), sum(v * v for v in vehicle.vel) ** 0.5
        where = f"was at ({place}) m with {speed:.1f} m/s, its pose {1e3 * vehicle.age:.0f} ms old"
    return f"It went wrong {at['time'] - at['since']:.2f} s into '{at['state']}': {why}; the vehicle {where}."
