"""OptiTrack's Motive for tests: its datagrams by NatNet 3.1, written from the layout that
NaturalPoint publishes, and a server on loopback that answers the handshake.
"""

import socket
import struct
import threading

SERVER_INFO, FRAME = 1, 7


def message(kind: int, payload: bytes) -> bytes:
    """Return a datagram."""
    return struct.pack("<HH", kind, len(payload)) + payload


def server_info() -> bytes:
    """Return the answer to the handshake: Motive 3.1, NatNet 3.1."""
    ports = struct.pack("<QHB4B", 10**7, 1511, 0, 0, 0, 0, 0)
    return message(SERVER_INFO, b"Motive".ljust(256, b"\0") + bytes([3, 1, 0, 0] * 2) + ports)


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
    """Streams to whoever has said hello; ``client`` is its address."""

    def __init__(self, host: str = "127.0.0.1") -> None:
        self._socket = socket.socket(socket.AF_INET, socket.SOCK_DGRAM)
        self._socket.bind((host, 1510))
        self.client: tuple[str, int] | None = None
        threading.Thread(target=self._answer, daemon=True).start()

    def _answer(self) -> None:
        while True:
            try:
                data, sender = self._socket.recvfrom(2048)
            except OSError:
                return
            if data[:2] == b"\0\0":
                self._socket.sendto(server_info(), sender)
                self.client = sender

    def send(self, data: bytes) -> None:
        """Send a datagram."""
        self._socket.sendto(data, self.client)

    def close(self) -> None:
        """Stop."""
        self._socket.close()
