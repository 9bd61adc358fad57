"""CRTP, the Crazyflie's packets: ports, their layout, and the links that carry them.

A packet is a header, port in the high half and channel in the low two bits, and up to 30 bytes. On
``udpout:`` devices each datagram is a packet, as cflib's UDP driver and Bitcraze's software in the
loop have it; ``radio://`` and ``usb://`` addresses go through cflib.

Source: bitcraze.io, CRTP; crazyflie-firmware, src/modules/interface/crtp.h, crtp_commander_rpyt.c
(legacy set-point), param_logic.c (set by name), supervisor; cflib, crtp/udpdriver.py,
crazyflie/supervisor.py."""

import struct
from dataclasses import dataclass
from typing import Any

from hil.errors import LinkError
from hil.links.device import check_device, open_port
from visthrow.common.extras import load_extra

PARAM, COMMANDER, LOCALIZATION, SUPERVISOR = 2, 3, 6, 9  # ports

BY_NAME, GENERIC, INFO, COMMAND = 3, 1, 0, 1
"""Channels: of parameters by name, of localization's further messages, of the supervisor's state
and commands.
"""

SET_POINT, POSE = struct.Struct("<fffH"), struct.Struct("<B7f")

EXTERNAL_POSE, SET_BY_NAME, UINT8, STATE, ARM, ANSWER = (
    8,
    0,
    0x08,
    0x0C,
    0x01,
    0x80,
)  # types within packets
ARMED, CAN_FLY, FLYING, TUMBLED, LOCKED = (
    1 << 1,
    1 << 3,
    1 << 4,
    1 << 5,
    1 << 6,
)  # bits of the supervisor's state
MOST = 31  # bytes of a packet

CFLIB = ("radio://", "usb://", "serial://")


@dataclass(frozen=True)
class Packet:
    """One packet."""

    port: int
    channel: int
    data: bytes

    def pack(self) -> bytes:
        """Return its bytes as they go out."""
        return bytes([(self.port & 0xF) << 4 | self.channel & 3]) + self.data


def unpack(data: bytes) -> Packet | None:
    """Return the packet of some bytes; None where they are none."""
    return Packet(data[0] >> 4, data[0] & 3, data[1:]) if 1 <= len(data) <= MOST else None


def set_point(thrust: int, rates_dps: tuple[float, float, float]) -> bytes:
    """Return the legacy set-point: thrust of 65535, body rates forward, left, up [deg/s]; the
    firmware's pitch is nose down.
    """
    roll, pitch, yaw = rates_dps
    return Packet(COMMANDER, 0, SET_POINT.pack(roll, -pitch, yaw, thrust)).pack()


def external_pose(pos: tuple[float, ...], quat: tuple[float, ...]) -> bytes:
    """Return the position [m], z up, and attitude xyzw for its estimator."""
    return Packet(LOCALIZATION, GENERIC, POSE.pack(EXTERNAL_POSE, *pos, *quat)).pack()


def named(name: str) -> bytes:
    """Return a parameter's name ``group.name`` as packets have it."""
    return name.replace(".", "\0").encode() + b"\0"


def set_parameter(name: str, value: int) -> bytes:
    """Return a parameter of eight bits, by its name."""
    return Packet(PARAM, BY_NAME, bytes([SET_BY_NAME]) + named(name) + bytes([UINT8, value])).pack()


def arm(on: bool) -> bytes:
    """Return the request to arm or disarm."""
    return Packet(SUPERVISOR, COMMAND, bytes([ARM, on])).pack()


class CflibPort:
    """A radio or USB link of cflib; a `hil.links.device.Port`."""

    whole, sender, peer = True, None, None

    def __init__(self, address: str) -> None:
        """Open it; raises `LinkError` where cflib is missing, or the link cannot be opened."""
        crtp = load_extra("cflib.crtp", "crazyflie", f"the Crazyflie at {address}", LinkError)
        self._packet = load_extra(
            "cflib.crtp.crtpstack", "crazyflie", "the Crazyflie", LinkError
        ).CRTPPacket
        self.lost: str | None = None
        try:
            crtp.init_drivers()
            self._link: Any = crtp.get_link_driver(address, None, self._lose)
        except Exception as error:  # USB, and the package's own
            raise LinkError(f"cannot open {address}: {error}") from error
        if self._link is None:
            raise LinkError(
                f"cannot open {address}: no driver of cflib takes it; expected"
                f" {', '.join(CFLIB)}..."
            )

    def _lose(self, message: str) -> None:
        self.lost = message

    def read(self) -> bytes | None:
        packet = self._link.receive_packet(0)
        return None if packet is None else bytes([packet.header]) + bytes(packet.data)

    def write(self, data: bytes, to: tuple[str, int] | None = None) -> bool:
        packet = self._packet(data[0])
        packet.data = data[1:]
        self._link.send_packet(packet)
        return self.lost is None

    def fileno(self) -> int:
        """Return -1: its packets come by a thread; nothing can be waited for."""
        return -1

    def close(self) -> None:
        self._link.close()


def open_crtp(device: str, remote: bool) -> Any:
    """Open the port of a device; raises `LinkError` where it is refused, or cannot be opened."""
    return (
        CflibPort(device)
        if device.startswith(CFLIB)
        else open_port(check_device(device, remote=remote), "--set crazyflie.device=...")
    )
