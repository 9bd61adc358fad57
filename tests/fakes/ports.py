"""Ports of flight controllers in software, which wait for a peer."""

import socket
from abc import abstractmethod

from hil.errors import LinkError
from hil.links.device import LARGEST_DATAGRAM, UdpPort, chunks, make_port_error
from hil.rehearsal.fake import THRUST, Fake


class ListeningPort:
    """A TCP port of this machine that serves one peer at a time: what a flight controller in
    software offers.
    """

    whole, sender, peer = False, None, None

    def __init__(self, number: int) -> None:
        """Listen on a port of the loopback address; raises `LinkError` where it is taken, or there
        is none of that number.
        """
        if not 1 <= number <= 65535:
            raise LinkError(f"tcp port {number}; expected 1 to 65535")
        try:
            self._server = socket.create_server(("127.0.0.1", number), backlog=1)
        except OSError as error:
            raise make_port_error(
                f"tcp:127.0.0.1:{number}", number, error, "--msp-port PORT"
            ) from error
        self._server.setblocking(False)
        self._peer: socket.socket | None = None

    def read(self) -> bytes | None:
        if self._peer is None:
            try:
                self._peer, _ = self._server.accept()
            except OSError:
                return None
            self._peer.setblocking(False)
            self._peer.setsockopt(socket.IPPROTO_TCP, socket.TCP_NODELAY, 1)
        try:
            data = self._peer.recv(LARGEST_DATAGRAM)
        except BlockingIOError:
            return None
        except OSError:
            data = b""
        if not data:  # the peer has gone: the next one may come
            self._peer.close()
            self._peer = None
        return data or None

    def write(self, data: bytes, to: tuple[str, int] | None = None) -> bool:
        try:
            return self._peer is not None and self._peer.send(data) == len(data)
        except OSError:
            return False

    def fileno(self) -> int:
        return (self._peer or self._server).fileno()

    def close(self) -> None:
        for one in (self._server, self._peer):
            if one is not None:
                one.close()


class AnsweringPort(UdpPort):
    """A UDP port that answers the last sender: what a vehicle in software offers."""

    def write(self, data: bytes, to: tuple[str, int] | None = None) -> bool:
        return super().write(data, to or self.sender)


class PortFake(Fake):
    """An autopilot whose commands come by a port of its own, beside the link of the
    motion capture.
    """

    thrust_map = THRUST

    @abstractmethod
    def came(self, data: bytes) -> None:
        """Take what came on the port."""

    def hear(self) -> None:
        for data in chunks(self.port):
            self.heard = self.wall()
            self.came(data)
        super().hear()

    def close(self) -> None:
        super().close()
        self.port.close()
