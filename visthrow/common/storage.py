"""Write results as whole files or not at all, and limit the unpacked size of a file before it is
read. Onboard-safe: standard library and numpy only.
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

MOST_UNPACKED = 256 << 20  # unpacked size that is always allowed [bytes]
MOST_TIMES = 50  # allowed ratio of unpacked to packed size of a larger file; logs have 2 to 20
PIECE = 1 << 20  # size of the pieces that are unpacked [bytes]
PROGRESS_PERIOD = 3.0  # time between progress messages [s]


def atomic_write(path: str | Path, content: bytes | str) -> None:
    """Write bytes, or text as UTF-8, so that the path always holds either the old or the whole new
    content.

    The content is written to a temporary file in the same folder, flushed to the disk, and renamed
    atomically; missing folders are created. Raises StorageError: the disk is full or the file
    cannot be written; no partial file remains."""
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
        os.chmod(temporary, 0o644 & ~mask)  # mkstemp makes it readable only for its owner
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
    """Create the folder for results before the work. Raises StorageError: it cannot be created or
    written.
    """
    try:
        folder.mkdir(parents=True, exist_ok=True)
    except OSError as error:
        raise StorageError(f"cannot make the folder {folder}: {error.strerror or error}") from error
    if not os.access(folder, os.W_OK):
        raise StorageError(f"the folder {folder} cannot be written")


def check_place(path: str | Path) -> None:
    """Raise StorageError if a file could not be written after the work; nothing is created."""
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
    """Write a value as indented JSON, atomically; NaN and infinity, which JSON does not have,
    become null.
    """
    atomic_write(path, json.dumps(_replace_nan(value), indent=2, allow_nan=False) + "\n")


def savez(path: str | Path, arrays: dict[str, ndarray]) -> None:
    """Write named arrays as a compressed ``.npz``, atomically and without pickle.

    Raises ValueError: an array holds Python objects.
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
    """Raise ``error`` for a file that unpacks to at least ``unpacked`` bytes, if that is too much
    for its size.
    """
    size = Path(path).stat().st_size
    limit = max(MOST_UNPACKED, MOST_TIMES * size)
    if unpacked > limit:
        raise error(
            f"{path}: {size / 1e6:.1f} MB that unpack to at least {unpacked / 1e6:.0f} MB; expected"
            f" {limit / 1e6:.0f} MB at most. If the file is correct, unpack it first"
        )


def unpack(path: str | Path, open_: Callable[..., IO[bytes]], error: type[Exception]) -> bytes:
    """Return the content of a packed file, after a first pass that only measures its unpacked size.

    Raises ``error``: the size is too large; and the errors of ``open_``.
    """
    with open_(path, "rb") as file:
        total = 0
        while piece := file.read(PIECE):
            total += len(piece)
            require_room(path, total, error)
    with open_(path, "rb") as file:
        return file.read()


def count_lines(lines: Iterable[str], length: int, name: str) -> Iterator[str]:
    """Yield the lines of a text of ``length`` characters and report progress on standard error."""
    begin = time.monotonic()
    done = 0
    for line in lines:
        yield line
        done += len(line)
        if time.monotonic() - begin > PROGRESS_PERIOD:
            begin = time.monotonic()
            print(f"{name}: {done / length:.0%} read", file=sys.stderr, flush=True)


def loadz(path: str | Path, error: type[Exception], what: str) -> dict[str, ndarray]:
    """Read all arrays of an ``.npz`` without pickle.

    Raises ``error``: the file does not exist, is truncated, damaged or no archive, or its unpacked
    size is too large."""
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
    except Exception as cause:  # zipfile, zlib, numpy and the OS raise different errors
        size = path.stat().st_size
        # for a file that is no archive, numpy recommends pickle
        why = "no .npz archive" if "pickle" in str(cause) else cause
        raise error(
            f"{path}: truncated or damaged ({size} bytes: {why}); expected {what}"
        ) from cause


def json_array(value: Any) -> ndarray:
    """Pack a value as JSON into an array of bytes, for storage in an ``.npz``."""
    return np.frombuffer(
        json.dumps(value, sort_keys=True, allow_nan=False).encode("utf-8"), dtype=np.uint8
    )


def from_json_array(array: ndarray) -> Any:
    """Return the value of an array of ``json_array``. Raises ValueError: it holds no JSON."""
    return json.loads(np.asarray(array, dtype=np.uint8).tobytes().decode("utf-8"))


def _replace_nan(value: Any) -> Any:
    if isinstance(value, dict):
        return {str(key): _replace_nan(item) for key, item in value.items()}
    if isinstance(value, list | tuple):
        return [_replace_nan(item) for item in value]
    if isinstance(value, np.generic | ndarray):
        return _replace_nan(value.tolist())
    return None if isinstance(value, float) and not np.isfinite(value) else value
