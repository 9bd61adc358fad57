"""What goes over an MSP port, both ways, in a file: for each chunk the time [us], the direction, its length, its bytes."""

import struct
import time
from pathlib import Path

from hil.errors import LinkError
from hil.links.device import Port

HEAD = struct.Struct(">QcH")
"""Time since 1970 [us], b"<" to the flight controller or b">" from it, number of bytes."""

MOST_BYTES = 65535
"""Length of a chunk in the file; a longer one is cut."""


class LoggedPort:
    """A port whose traffic is written down; a write to the file that fails is counted and troubles nobody.

    Attributes:
        failed: number of chunks that could not be written.
    """

    def __init__(self, port: Port, path: str | Path) -> None:
        """Open the file.

        Raises:
            LinkError: it cannot be written.
        """
        self._port, self.whole, self.sender, self.peer, self.failed = port, port.whole, None, None, 0
        try:
            Path(path).parent.mkdir(parents=True, exist_ok=True)
            self._file = open(path, "wb", buffering=1 << 16)  # noqa: SIM115 - closed in close()
        except OSError as error:
            port.close()
            raise LinkError(f"cannot write {path}: {error.strerror}") from error

    def _note(self, direction: bytes, data: bytes) -> None:
        data = data[:MOST_BYTES]
        try:
            self._file.write(HEAD.pack(int(time.time() * 1e6), direction, len(data)) + data)
        except (OSError, ValueError):
            self.failed += 1

    def read(self) -> bytes | None:
        data = self._port.read()
        if data:
            self._note(b">", data)
        return data

    def write(self, data: bytes, to: tuple[str, int] | None = None) -> bool:
        taken = self._port.write(data)
        if taken:
            self._note(b"<", data)
        return taken

    def fileno(self) -> int:
        return self._port.fileno()

    def close(self) -> None:
        self._port.close()
        try:
            self._file.close()
        except OSError:
            self.failed += 1

