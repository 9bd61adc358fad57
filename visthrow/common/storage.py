"""Writing of results: whole files or none; and bounds on what a file may unpack to, looked at
before it is read. Onboard-safe: standard library and numpy only.
"""

import io
import json
import os
import sys
import tempfile
import time
from collections.abc import Callable, Iterable, Iterator
from contextlib import suppress
from pathlib import Path
from typing import IO, Any

import numpy as np
from numpy import ndarray

from visthrow.common.errors import StorageError

MOST_UNPACKED = 256 << 20  # bytes that any file may unpack to
MOST_TIMES = 50  # times its own size that a larger one may; logs of numbers take 2 to 20
PIECE = 1 << 20  # bytes that are unpacked in one go
SAY_EVERY = 3.0  # between two words on a read [s]


def atomic_write(path: str | Path, content: bytes | str) -> None:
    """Write bytes, or text as UTF-8, so that the path always holds the old content or the whole new
    one.

    The content goes to a temporary file beside it, is flushed to the disk, and takes the name in
    one step; folders are made. Raises StorageError if the disk is full or the place cannot be
    written; nothing half-written is left."""
    path = Path(path)
    data = content.encode("utf-8") if isinstance(content, str) else content
    temporary = None
    try:
        path.parent.mkdir(parents=True, exist_ok=True)
        handle, temporary = tempfile.mkstemp(
            dir=path.parent, prefix=f".{path.name}.", suffix=".tmp"
        )
        with os.fdopen(handle, "wb") as file:
            file.write(data)
            file.flush()
            os.fsync(file.fileno())
        os.umask(mask := os.umask(0))
        os.chmod(temporary, 0o644 & ~mask)  # mkstemp makes it readable for its owner alone
        os.replace(temporary, path)
        temporary = None
    except OSError as error:
        raise StorageError(
            f"cannot write {path} ({len(data)} bytes): {error.strerror or error}"
        ) from error
    finally:
        if temporary is not None:
            with suppress(OSError):
                os.unlink(temporary)


def writable(folder: Path) -> None:
    """Make the folder of the results now, so that no work is done for results that could not be
    written; StorageError then.
    """
    try:
        folder.mkdir(parents=True, exist_ok=True)
    except OSError as error:
        raise StorageError(f"cannot make the folder {folder}: {error.strerror or error}") from error
    if not os.access(folder, os.W_OK):
        raise StorageError(f"the folder {folder} cannot be written")


def check_place(path: str | Path) -> None:
    """Raise StorageError, before the work, for a file that could not be written after it; makes
    nothing.
    """
    path = Path(path)
    if path.is_dir():
        raise StorageError(f"cannot write {path}: it is a folder; expected a file")
    above = next(folder for folder in path.absolute().parents if folder.exists())
    if not above.is_dir() or not os.access(above, os.W_OK):
        raise StorageError(
            f"cannot write {path}: {above} is"
            f" {'a folder that cannot be written' if above.is_dir() else 'no folder'}"
        )


def write_json(path: str | Path, value: Any) -> None:
    """Write a value as indented JSON, atomically; NaN and infinity become null, as JSON has
    neither.
    """
    atomic_write(path, json.dumps(_replace_nan(value), indent=2, allow_nan=False) + "\n")


def savez(path: str | Path, arrays: dict[str, ndarray]) -> None:
    """Write named arrays as a compressed ``.npz``, atomically and without pickle; ValueError if one
    holds Python objects.
    """
    for name, array in arrays.items():
        if np.asarray(array).dtype.hasobject:
            raise ValueError(
                f"array '{name}' holds Python objects; expected numbers, bools or text"
            )
    buffer = io.BytesIO()
    np.savez_compressed(buffer, **arrays)
    atomic_write(path, buffer.getvalue())


def require_room(path: str | Path, unpacked: int, error: type[Exception]) -> None:
    """Raise ``error`` for a file that unpacks to so many bytes, or to more, where that is too much
    for its size.
    """
    size = Path(path).stat().st_size
    limit = max(MOST_UNPACKED, MOST_TIMES * size)
    if unpacked > limit:
        raise error(
            f"{path}: {size / 1e6:.1f} MB that unpack to at least {unpacked / 1e6:.0f} MB; expected"
            f" {limit / 1e6:.0f} MB at most. Where it is right, unpack it first"
        )


def unpack(path: str | Path, open_: Callable[..., IO[bytes]], error: type[Exception]) -> bytes:
    """Return what a packed file holds, once it has been unpacked and measured without keeping it;
    raises ``error`` where it is too much, and what ``open_`` raises.
    """
    with open_(path, "rb") as file:
        total = 0
        while piece := file.read(PIECE):
            total += len(piece)
            require_room(path, total, error)
    with open_(path, "rb") as file:
        return file.read()


def count_lines(lines: Iterable[str], length: int, name: str) -> Iterator[str]:
    """Yield lines of a text of a length, and say on standard error how far that is."""
    begin = time.monotonic()
    done = 0
    for line in lines:
        yield line
        done += len(line)
        if time.monotonic() - begin > SAY_EVERY:
            begin = time.monotonic()
            print(f"{name}: {done / length:.0%} read", file=sys.stderr, flush=True)


def loadz(path: str | Path, error: type[Exception], what: str) -> dict[str, ndarray]:
    """Read all arrays of an ``.npz`` without pickle.

    Raises Exception: of class ``error``: no such file, cut short, damaged, not what it should be,
    or more of it than its size lets expect."""
    path = Path(path)
    if not path.is_file():
        if path.parent.is_dir():
            hint = sorted(p.name for p in path.parent.glob(f"*{path.suffix or '.npz'}"))
        else:
            hint = []
        raise error(
            f"{path}: no such file; expected {what}. In that folder:"
            f" {', '.join(hint) or 'nothing of the kind'}"
        )
    try:
        with np.load(path, allow_pickle=False) as archive:
            require_room(path, sum(part.file_size for part in archive.zip.infolist()), error)
            return {name: archive[name] for name in archive.files}
    except error:
        raise
    except Exception as cause:  # zipfile, zlib, numpy and the OS each have their own way to say it
        size = path.stat().st_size
        # For what is no archive at all numpy recommends to unpickle it.
        why = "no .npz archive" if "pickle" in str(cause) else cause
        raise error(
            f"{path}: cut short or damaged ({size} bytes: {why}); expected {what}"
        ) from cause


def json_array(value: Any) -> ndarray:
    """Pack a JSON-able value into an array of bytes, for storage in an ``.npz``."""
    return np.frombuffer(
        json.dumps(value, sort_keys=True, allow_nan=False).encode("utf-8"), dtype=np.uint8
    )


def from_json_array(array: ndarray) -> Any:
    """Undo ``json_array``; ValueError if the array holds no JSON."""
    return json.loads(np.asarray(array, dtype=np.uint8).tobytes().decode("utf-8"))


def _replace_nan(value: Any) -> Any:
    if isinstance(value, dict):
        return {str(key): _replace_nan(item) for key, item in value.items()}
    if isinstance(value, list | tuple):
        return [_replace_nan(item) for item in value]
    if isinstance(value, np.generic | ndarray):
        return _replace_nan(value.tolist())
    return None if isinstance(value, float) and not np.isfinite(value) else value
