"""Files of link traffic and of a run's ticks, each written by its own thread, so that a slow
disk delays no tick.
"""

import struct
import threading
import time
from collections import deque
from pathlib import Path
from typing import Any

from hil.links.device import Port
from visthrow.common.errors import StorageError

# files in a run's folder
TLOG = "link.tlog"
POSES_TLOG = "poses.tlog"  # of poses on a separate port
MSP_LOG = "link.msp"
# most chunks that wait for a slow disk, some minutes' worth; further chunks are lost and counted
MOST_WAITING = 100_000

WRITE_EVERY = 0.1
"""Period of the writing thread [s]. If each chunk woke it, it would take the core from the
control loop.
"""

HEAD = struct.Struct(
    ">QcH"
    # of a chunk of MSP: time since 1970 [us], b"<" to the flight controller or b">" from it, number
    # of bytes
)
MOST_BYTES = 65535  # longest chunk of MSP in the file; longer ones are cut


class Writer:
    """A file that is appended to by a thread; :meth:`put` never waits or raises.

    ``failed`` counts chunks that were not written; ``why`` is the reason for the first.
    """

    def __init__(self, path: str | Path):
        """Open the file; raises `StorageError` where it cannot be written."""
        try:
            Path(path).parent.mkdir(parents=True, exist_ok=True)
            self._file = open(path, "wb", buffering=65536)  # noqa: SIM115 - closed in close()
        except OSError as error:
            raise StorageError(
                f"cannot write {path}: {error.strerror}; expected a folder that can be written"
                " (--out)"
            ) from error
        self._name = Path(path).name
        self.failed = 0
        self.why = None
        self._waiting: deque[bytes] = deque()
        self._over = threading.Event()
        self._thread = threading.Thread(target=self._write, name=self._name, daemon=True)
        self._thread.start()

    def put(self, data: bytes) -> None:
        """Queue bytes for writing."""
        if len(self._waiting) < MOST_WAITING:
            self._waiting.append(data)
        else:
            self._fail("the disk is too slow")

    def _fail(self, why: Any) -> None:
        self.failed += 1
        self.why = self.why or f"cannot write {self._name}: {why}"

    def _write(self) -> None:
        closing = False
        while not closing:
            closing = self._over.wait(WRITE_EVERY)
            try:
                while self._waiting:
                    self._file.write(self._waiting.popleft())
                self._file.flush()
            except (OSError, ValueError) as error:
                self._fail(error)
                self.failed += len(self._waiting)
                self._waiting.clear()

    def close(self) -> None:
        """Write the remaining chunks and close the file."""
        self._over.set()
        self._thread.join()
        try:
            self._file.close()
        except OSError as error:
            self._fail(error)


class TlogWriter(Writer):
    """A .tlog: for each message the time [us, big-endian] and its bytes."""

    def write(self, message: Any, unix_time: float | None = None) -> None:
        """Append a message, parsed or packed; ``unix_time``: its time [s], by default now."""
        stamp = int((time.time() if unix_time is None else unix_time) * 1e6)
        self.put(struct.pack(">Q", stamp) + bytes(message.get_msgbuf()))


class LoggedPort:
    """A port whose traffic in both directions is recorded; :data:`HEAD` is the format."""

    def __init__(self, port: Port, path: str | Path):
        """Open the file; raises `StorageError` where it cannot be written."""
        self._port = port
        try:
            self.log = Writer(path)
        except StorageError:
            port.close()
            raise

    def _note(self, direction: bytes, data: bytes) -> None:
        data = data[:MOST_BYTES]
        self.log.put(HEAD.pack(int(time.time() * 1e6), direction, len(data)) + data)

    def read(self) -> bytes | None:
        data = self._port.read()
        if data:
            self._note(b">", data)
        return data

    def write(self, data: bytes, address: tuple[str, int] | None = None) -> bool:
        taken = self._port.write(data)
        if taken:
            self._note(b"<", data)
        return taken

    def __getattr__(self, name: str) -> Any:
        return getattr(self._port, name)

    def close(self) -> None:
        self._port.close()
        self.log.close()
