"""A lock that no two processes hold at once and that a dead one does not hold: the kernel lets go of it with the process."""

import fcntl
import json
import os
import platform
import time
from pathlib import Path
from types import TracebackType
from typing import Any

from visthrow.common.errors import BusyError


class Lock:
    """Lock on a file, as a context manager; the file says who has it. Works across machines where the file system's does."""

    def __init__(self, path: Path) -> None:
        self.path = path

    def __enter__(self) -> "Lock":
        """Take it.

        Raises:
            BusyError: another process has it.
        """
        self.path.parent.mkdir(parents=True, exist_ok=True)
        self._handle = os.open(self.path, os.O_RDWR | os.O_CREAT, 0o644)
        try:
            fcntl.flock(self._handle, fcntl.LOCK_EX | fcntl.LOCK_NB)
        except OSError:
            os.close(self._handle)
            raise BusyError(f"{self.path}: another process works on it: {owner(self.path) or 'it does not say which'}") from None
        text = json.dumps({"process": os.getpid(), "machine": platform.node(), "since": time.time()})
        os.ftruncate(self._handle, 0)
        os.write(self._handle, text.encode())
        return self

    def __exit__(self, kind: type | None, error: BaseException | None, trace: TracebackType | None) -> None:
        os.ftruncate(self._handle, 0)
        os.close(self._handle)  # the file stays: removing it would let two processes lock two files of one name


def owner(path: Path) -> dict[str, Any] | None:
    """Who says that he has it; a process that was killed says so still."""
    try:
        return json.loads(path.read_text())
    except (OSError, ValueError):
        return None


def held(path: Path) -> bool:
    """Whether a living process has it."""
    try:
        handle = os.open(path, os.O_RDWR)
    except FileNotFoundError:
        return False
    try:
        fcntl.flock(handle, fcntl.LOCK_EX | fcntl.LOCK_NB)
        return False
    except OSError:
        return True
    finally:
        os.close(handle)
