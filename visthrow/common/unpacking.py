"""Bounds on what a packed file may unpack to, looked at before it is read; and how far a long read
has come.
"""

import sys
import time
from collections.abc import Callable, Iterable, Iterator
from pathlib import Path
from typing import IO

MOST = 256 << 20  # bytes that any file may unpack to
MOST_TIMES = 50  # times its own size that a larger one may; logs of numbers take 2 to 20
PIECE = 1 << 20  # bytes that are unpacked in one go
SAY_EVERY = 3.0  # between two words on a read [s]


def require_room(path: str | Path, unpacked: int, error: type[Exception]) -> None:
    """Raise ``error`` for a file that unpacks to so many bytes, or to more, where that is too much
    for its size.
    """
    size = Path(path).stat().st_size
    most = max(MOST, MOST_TIMES * size)
    if unpacked > most:
        raise error(
            f"{path}: {size / 1e6:.1f} MB that unpack to at least {unpacked / 1e6:.0f} MB; expected"
            f" {most / 1e6:.0f} MB at most. Where it is right, unpack it first"
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


def counted(lines: Iterable[str], length: int, name: str) -> Iterator[str]:
    """Yield lines of a text of a length, and say on standard error how far that is."""
    begin, done = time.monotonic(), 0
    for line in lines:
        yield line
        done += len(line)
        if time.monotonic() - begin > SAY_EVERY:
            begin = time.monotonic()
            print(f"{name}: {done / length:.0%} read", file=sys.stderr, flush=True)
