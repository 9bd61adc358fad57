"""Frames of the package motioncapture, written by a separate process.

The package's C++ libraries block, and do not check the length of received data. If they crash, they
end this process but not the run. ``python capture.py SYSTEM OPTIONS NAMES``, the last two as JSON,
writes what :func:`listen` puts on standard output, as JSON, a line each. It imports nothing but the
standard library.

Source: Linux, filter.rst (classic BPF on sockets) and SO_MEMINFO."""

import ctypes
import json
import os
import signal
import socket
import struct
import sys
import time
from collections.abc import Callable
from pathlib import Path
from typing import Any

PAUSE = 1e-3  # after a frame that raised [s]
LOOK = 0.5  # between two searches for sockets that the package has opened [s]

PR_SET_PDEATHSIG = 1
SO_ATTACH_FILTER = 26
SO_MEMINFO = 55
DROPS = 8
PROGRAM = struct.Struct("HBBI")  # of one instruction of a filter: code, jump if true, if false, k
SENDER = 0xFFF00000 + 12  # SKF_NET_OFF and the place of the sender's address in IPv4's header
LOAD = 0x20
EQUAL = 0x15
RETURN = 0x06

Put = Callable[[Any], None]


class Strangers:
    """A kernel filter that keeps datagrams of senders other than the host from the sockets of
    this process, and counts them.
    """

    def __init__(self, host: str):
        """Take the host's IPv4 address."""
        address = struct.unpack("!I", socket.inet_aton(host))[0]
        rows = (
            (LOAD, 0, 0, SENDER),
            (EQUAL, 0, 1, address),
            (RETURN, 0, 0, 1 << 18),
            (RETURN, 0, 0, 0),
        )
        self._code = ctypes.create_string_buffer(b"".join(PROGRAM.pack(*row) for row in rows))
        self._filter = struct.pack("HP", len(rows), ctypes.addressof(self._code))
        self._known: set[str] = set()
        self._guarded: list[socket.socket] = []
        self._looked = -LOOK
        self._count = 0

    def look(self) -> int:
        """Attach the filter to new sockets from time to time; return the number of datagrams
        refused since the last call.
        """
        if time.monotonic() - self._looked < LOOK:
            return 0
        self._looked = time.monotonic()
        for link in Path("/proc/self/fd").iterdir():
            name = os.readlink(link) if link.is_symlink() else ""
            if name.startswith("socket:") and name not in self._known:
                self._known.add(name)
                self._guard(int(link.name))
        before = self._count
        self._count = sum(map(_count_dropped, self._guarded))
        return self._count - before

    def _guard(self, number: int) -> None:
        bodies = socket.socket(fileno=os.dup(number))
        if (bodies.family, bodies.type) == (socket.AF_INET, socket.SOCK_DGRAM):
            bodies.setsockopt(socket.SOL_SOCKET, SO_ATTACH_FILTER, self._filter)
            self._guarded.append(bodies)
        else:
            bodies.close()


def _count_dropped(sock: socket.socket) -> int:
    """Return the number of datagrams that the kernel dropped for a socket."""
    memory = sock.getsockopt(socket.SOL_SOCKET, SO_MEMINFO, 4 * (DROPS + 1))
    return struct.unpack_from("I", memory, 4 * DROPS)[0]


def listen(
    connect: Callable[[str, dict[str, str]], Any],
    system: str,
    options: dict[str, str],
    names: list[str],
    put: Put,
    going: Callable[[], bool] = lambda: True,
    strangers: Strangers | None = None,
) -> None:
    """Connect, and put what comes: None once connected, the bodies of a frame, a text for what
    could not be taken, a number of datagrams of others.

    A frame or a body that raises is reported, and the next one taken. Ends by what connecting
    raises, or once ``going`` returns False.
    """
    capture = connect(system, options)
    put(None)
    while going():
        if strangers is not None and (count := strangers.look()):
            put(count)
        try:
            capture.waitForNextFrame()
            bodies = capture.rigidBodies
            ours = [name for name in bodies if name in names]
        except Exception as error:  # of the package: a frame that it cannot read
            put(f"frame: {type(error).__name__}: {error}")
            time.sleep(PAUSE)
            continue
        frame = {}
        for name in ours:
            try:
                frame[name] = _numbers(bodies[name])
            except Exception as error:  # likewise: a body that is occluded
                put(f"body {name}: {type(error).__name__}: {error}")
        if frame:
            put(frame)


def _numbers(body: Any) -> list[float]:
    """Return position and quaternion xyzw of a body."""
    x, y, z = body.position
    q = body.rotation
    return [float(value) for value in (x, y, z, q.x, q.y, q.z, q.w)]


def main() -> None:
    """Listen on behalf of the parent process, and end with it."""
    system, options, names = sys.argv[1], *map(json.loads, sys.argv[2:4])
    out = os.fdopen(os.dup(1), "w")
    os.dup2(2, 1)  # what the package prints is none of ours
    strangers = None
    if sys.platform == "linux":
        ctypes.CDLL(None).prctl(PR_SET_PDEATHSIG, signal.SIGKILL)
        strangers = Strangers(options["hostname"]) if ":" not in options["hostname"] else None

    def put(value: Any) -> None:
        out.write(json.dumps(value) + "\n")
        out.flush()

    import motioncapture

    listen(motioncapture.connect, system, options, names, put, strangers=strangers)


if __name__ == "__main__":
    main()
