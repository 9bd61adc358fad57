"""OptiTrack's Motive for tests: its datagrams by NatNet 3.1, written from the layout that
NaturalPoint publishes, and a server on loopback that answers the handshake.
"""

import socket
import struct
import threading

SERVER_INFO, MODELS, FRAME = 1, 5, 7


def message(kind: int, payload: bytes) -> bytes:
    """Return a datagram."""
    return struct.pack("<HH", kind, len(payload)) + payload


def server_info() -> bytes:
    """Return the answer to the handshake: Motive 3.1, NatNet 3.1."""
    ports = struct.pack("<QHB4B", 10**7, 1511, 0, 0, 0, 0, 0)
    return message(SERVER_INFO, b"Motive".ljust(256, b"\0") + bytes([3, 1, 0, 0] * 2) + ports)


def models(names: dict[int, str]) -> bytes:
    """Return the rigid bodies' definitions, without markers, by streaming id."""
    rows = b"".join(
        struct.pack("<I", 1) + name.encode() + b"\0" + struct.pack("<II3fI", number, 0, 0, 0, 0, 0)
        for number, name in names.items()
    )
    return message(MODELS, struct.pack("<I", len(names)) + rows)


def frame(stamp: float, *bodies: tuple[int, tuple, tuple, bool]) -> bytes:
    """Return a frame at a stamp [s]: streaming id, position [m], quaternion xyzw and whether it is
    tracked, of each body.
    """
    rows = b"".join(
        struct.pack("<I3f4ffH", number, *pos, *quat, 0.0, tracked)
        for number, pos, quat, tracked in bodies
    )
    head = struct.pack("<IIII", 0, 0, 0, len(bodies))  # frame, marker sets, unlabelled markers
    # skeletons, labelled markers, force plates, devices; time code, stamp, three clocks, flags
    tail = struct.pack("<IIII", 0, 0, 0, 0) + struct.pack("<IIdQQQH", 0, 0, stamp, 0, 0, 0, 0)
    return message(FRAME, head + rows + tail)


class Motive:
    """Streams to the last client that connected; ``client`` is its address."""

    def __init__(self) -> None:
        self._socket = socket.socket(socket.AF_INET, socket.SOCK_DGRAM)
        self._socket.bind(("127.0.0.1", 1510))
        self._socket.settimeout(0.1)
        self.client: tuple[str, int] | None = None
        self._closed = threading.Event()
        self._thread = threading.Thread(target=self._answer, daemon=True)
        self._thread.start()

    def _answer(self) -> None:
        while not self._closed.is_set():
            try:
                data, sender = self._socket.recvfrom(2048)
            except TimeoutError:
                continue
            if data[:2] == b"\0\0":
                self._socket.sendto(server_info(), sender)
                self.client = sender
            elif data[:2] == b"\4\0":
                self._socket.sendto(models({7: "quad", 8: "ball"}), sender)

    def send(self, data: bytes) -> None:
        """Send a datagram to the client."""
        self._socket.sendto(data, self.client)

    def close(self) -> None:
        """Stop."""
        self._closed.set()
        self._thread.join()
        self._socket.close()
