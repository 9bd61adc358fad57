"""Device strings: which are allowed, and the ports behind them.

Nothing here is ever executed or looked up elsewhere.

``udp:HOST:PORT`` listens, ``udpout:HOST:PORT`` sends first, ``tcp:HOST:PORT`` connects,
``serial:/dev/NAME:BAUD`` opens a port. HOST is a numeric address; other than loopback ones only
where the config says so."""

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
# datagrams, or pieces of a stream, read in one go: a flood must not hold up the tick
MOST_CHUNKS = 256
# datagrams of strangers thrown away in one go, unread: 5 ms; they must not stand in the way of
# those that are ours
MOST_SHUT_OUT = 4096


@dataclass(frozen=True)
class Device:
    """A checked device string."""

    kind: str  # "udp", "udpout", "tcp" or "serial"
    host: str  # numeric address, or the path of the serial port
    port: int  # network port, or the baud rate


def check_device(text: str, *, remote: bool = False) -> Device:
    """Read a device string against the whitelist, loopback ones alone without ``remote``; raises
    `LinkError` with what is allowed.
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
    """A port for bytes in and out; neither call waits."""

    whole = False  # whether each chunk is a whole datagram
    sender: tuple[str, int] | None = None  # of the last chunk; None on a stream, which has one peer
    peer: tuple[str, int] | None = None  # that the device names; None where it names none
    _open: Any

    def read(self) -> bytes | None:
        """Return the next chunk; None where there is none."""
        raise NotImplementedError

    def write(self, data: bytes, address: tuple[str, int] | None = None) -> bool:
        """Return whether the bytes were taken; on UDP for an address, where the device does not
        name it.
        """
        raise NotImplementedError

    def fileno(self) -> int:
        """Return what can be waited for until there is something to read."""
        return self._open.fileno()

    def close(self) -> None:
        """Give the port back."""
        self._open.close()


def chunks(
    port: Port, refuses: Callable[[tuple[str, int] | None], bool] = lambda sender: False
) -> Iterator[bytes]:
    """Yield what has arrived at a port, at most `MOST_CHUNKS` chunks of it; no datagram of a sender
    that ``refuses`` returns True for.
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
    """Return the error that says why a port of this machine cannot be listened on and, where
    another program has it, what to do.

    Args:
        port: Its name, as ``udp:127.0.0.1:14560``.
        number: Its number.
        error: What the system said.
        option: Option that names another port; where there is none, the port cannot be changed.
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
    """A UDP socket; one that listens hears everybody, and says who sent what."""

    whole = True

    def __init__(self, device: Device, option: str = ""):
        """Open it; raises `LinkError` where the address is taken or not this machine's.

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
        except OSError:  # there is none, or the peer's port is closed: ICMP, reported here
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
    """A TCP connection, opened within two seconds or not at all."""

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
    """Open the port of a checked device string; raises `LinkError` where it cannot be opened.

    ``option``: the option that names another device; it stands in the message of a port that is
    taken."""
    if device.kind in ("udp", "udpout"):
        return UdpPort(device, option)
    return TcpPort(device) if device.kind == "tcp" else SerialPort(device)
