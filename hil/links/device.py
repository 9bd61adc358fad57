"""Device strings and the ports that they open.

A device string is only parsed: nothing is executed or resolved by name.

``udp:HOST:PORT`` listens, ``udpout:HOST:PORT`` sends first, ``tcp:HOST:PORT`` connects,
``serial:/dev/NAME:BAUD`` opens a port. HOST is a numeric address; addresses other than loopback
need the config's permission."""

import errno
import ipaddress
import os
import re
import socket
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from hil.errors import LinkError
from visthrow.common.extras import load_extra

_NETWORK = re.compile(r"(udp|udpout|tcp):([0-9.]+|\[[0-9a-fA-F:]+\]|localhost):([0-9]{1,5})")
_SERIAL = re.compile(
    r"serial:(/dev/(?:tty[A-Za-z0-9]+|serial/by-id/[\w.:+-]+|cu\.[\w-]+)):([0-9]{4,7})"
)
PLUGGED = ("serial/by-id/*", "ttyACM*", "ttyUSB*", "cu.*")  # names of serial ports in /dev
LARGEST_DATAGRAM = 65536
# most datagrams, or pieces of a stream, read in one call: a flood must not delay the tick
MOST_CHUNKS = 256
# most refused datagrams that one call discards, in 5 ms: they must not block the accepted ones
MOST_SHUT_OUT = 4096


@dataclass(frozen=True)
class Device:
    """A checked device string."""

    kind: str  # "udp", "udpout", "tcp" or "serial"
    host: str  # numeric address, or the path of the serial port
    port: int  # network port, or the baud rate


def check_device(text: str, *, remote: bool = False) -> Device:
    """Parse a device string; without ``remote`` only loopback addresses are allowed. Raises
    `LinkError` with the allowed forms.
    """
    match = _SERIAL.fullmatch(text)
    if match:
        return Device("serial", match[1], int(match[2]))
    match = _NETWORK.fullmatch(text)
    if not match:
        raise LinkError(
            f"device {text!r:.80} is refused; expected udp:127.0.0.1:14550 (listen),"
            " udpout:127.0.0.1:14550 (send first), tcp:127.0.0.1:5760 or"
            " serial:/dev/ttyACM0:921600"
        )
    host = "127.0.0.1" if match[2] == "localhost" else match[2].strip("[]")
    try:
        address = ipaddress.ip_address(host)
        port = int(match[3])
    except ValueError as error:
        raise LinkError(
            f"device {text!r}: {error}; expected a numeric address such as 127.0.0.1"
        ) from None
    if not 0 < port < 65536:
        raise LinkError(f"device {text!r}: port {port}; expected 1 to 65535")
    if not address.is_loopback and not remote:
        raise LinkError(
            f"device {text!r} is on another machine; set link.remote = true in the config to allow"
            " that"
        )
    return Device(match[1], host, port)


class Port:
    """A port for bytes in both directions; no call waits."""

    whole = False  # whether each chunk is a whole datagram
    sender: tuple[str, int] | None = None  # of the last chunk; None on a stream, which has one peer
    peer: tuple[str, int] | None = None  # address that the device names; None if it names none
    _open: Any

    def read(self) -> bytes | None:
        """Return the next chunk; None if there is none."""
        raise NotImplementedError

    def write(self, data: bytes, address: tuple[str, int] | None = None) -> bool:
        """Send bytes, on UDP to an address unless the device names one; return whether the
        system accepted them.
        """
        raise NotImplementedError

    def fileno(self) -> int:
        """Return the file descriptor to wait on for input."""
        return self._open.fileno()

    def close(self) -> None:
        """Close the port."""
        self._open.close()


def chunks(
    port: Port, refuses: Callable[[tuple[str, int] | None], bool] = lambda sender: False
) -> Iterator[bytes]:
    """Yield at most `MOST_CHUNKS` chunks that have arrived at a port, without datagrams of
    senders for which ``refuses`` returns True.
    """
    looked = shut_out = 0
    while looked < MOST_CHUNKS and shut_out < MOST_SHUT_OUT:
        data = port.read()
        if data is None:
            return
        if refuses(port.sender):
            shut_out += 1
            continue
        looked += 1
        yield data


def make_port_error(port: str, number: int, error: OSError, option: str = "") -> LinkError:
    """Return the error for a port of this machine that cannot be opened for listening, with advice
    if another program uses it.

    Args:
        port: Its name, as ``udp:127.0.0.1:14560``.
        number: Its number.
        error: What the system said.
        option: Option that selects another port; empty if the port is fixed.
    """
    if error.errno == errno.EADDRNOTAVAIL:
        return LinkError(
            f"cannot listen on {port}: no such address on this machine; expected one of its own, or"
            " 0.0.0.0 for all of them"
        )
    if error.errno != errno.EADDRINUSE:
        return LinkError(f"cannot listen on {port}: {error.strerror}")
    return LinkError(
        f"cannot listen on {port}: another program has it, perhaps a second `visthrow hil`, a"
        f" ground station or a simulator; `ss -{port[0]}lnp 'sport = :{number}'` shows which. End"
        f" it{option and ', or take another port: ' + option}"
    )


class UdpPort(Port):
    """A UDP socket; a listening one receives from all senders, and ``sender`` is that of the
    last chunk.
    """

    whole = True

    def __init__(self, device: Device, option: str = ""):
        """Open the socket. Raises `LinkError`: the address is in use or not this machine's.

        ``option``: as of `make_port_error`.
        """
        family = socket.AF_INET6 if ":" in device.host else socket.AF_INET
        self._open = socket.socket(family, socket.SOCK_DGRAM)
        self._open.setblocking(False)
        self.peer = (device.host, device.port) if device.kind == "udpout" else None
        try:
            if device.kind == "udp":
                self._open.bind((device.host, device.port))
        except OSError as error:
            self._open.close()
            raise make_port_error(
                f"{device.kind}:{device.host}:{device.port}", device.port, error, option
            ) from error

    def read(self) -> bytes | None:
        try:
            data, sender = self._open.recvfrom(LARGEST_DATAGRAM)
        except OSError:  # no data, or ICMP has reported that the peer's port is closed
            return None
        self.sender = sender[:2]
        return data

    def write(self, data: bytes, address: tuple[str, int] | None = None) -> bool:
        address = self.peer or address
        try:
            return address is not None and self._open.sendto(data, address) == len(data)
        except OSError:
            return False


class _Stream(Port):
    """A stream of bytes to and from one peer."""

    _get: Callable[[], bytes]
    _put: Callable[[bytes], int | None]

    def read(self) -> bytes | None:
        try:
            return self._get() or None
        except OSError:
            return None

    def write(self, data: bytes, address: tuple[str, int] | None = None) -> bool:
        try:
            return self._put(data) == len(data)
        except OSError:
            return False


class TcpPort(_Stream):
    """A TCP connection, with a time-out of two seconds for opening it."""

    def __init__(self, device: Device):
        """Connect; raises `LinkError` where nobody answers."""
        try:
            self._open = socket.create_connection((device.host, device.port), timeout=2.0)
        except OSError as error:
            raise LinkError(
                f"cannot connect to tcp:{device.host}:{device.port}: {error.strerror or error}"
            ) from error
        self._open.setsockopt(socket.IPPROTO_TCP, socket.TCP_NODELAY, 1)
        self._open.setblocking(False)
        self._get = lambda: self._open.recv(LARGEST_DATAGRAM)
        self._put = self._open.send


class SerialPort(_Stream):
    """A serial port."""

    def __init__(self, device: Device):
        """Open it; raises `LinkError` where pyserial is missing, or the port cannot be opened."""
        serial = load_extra("serial", "serial", "a serial port", LinkError)
        try:
            self._open = serial.Serial(device.host, device.port, timeout=0, write_timeout=0)
        except (serial.SerialException, ValueError) as error:
            number = getattr(error, "errno", None)  # pyserial's text names port and reason twice
            ports = ", ".join(
                str(path) for name in PLUGGED for path in sorted(Path("/dev").glob(name))
            )
            raise LinkError(
                f"cannot open {device.host}: {os.strerror(number) if number else error}; plugged in"
                f" here: {ports or 'no serial port'}"
            ) from error
        self._get = lambda: self._open.read(self._open.in_waiting or 1)
        self._put = self._open.write


def open_port(device: Device, option: str = "") -> Port:
    """Open the port of a checked device string. Raises `LinkError`: it cannot be opened.

    ``option``: option that selects another device, for the message if the port is in use."""
    if device.kind in ("udp", "udpout"):
        return UdpPort(device, option)
    return TcpPort(device) if device.kind == "tcp" else SerialPort(device)
