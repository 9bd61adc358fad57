"""CRTP, the Crazyflie's protocol: its packets and the links that carry them.

A packet is a header byte, with the port in the high half and the channel in the low two bits, and
up to 30 bytes of data. On ``udpout:`` devices each datagram is a packet, as in cflib's UDP driver
and Bitcraze's software in the loop; ``radio://`` and ``usb://`` addresses use cflib.

Source: `hil.links.facts`, crazyflie; cflib, crtp/udpdriver.py."""

import struct
from dataclasses import dataclass

from hil.errors import LinkError
from hil.links.device import Port, check_device, open_port
from hil.links.facts import values
from visthrow.common.extras import load_extra

FACTS = values("crazyflie")
MOST = FACTS["packet_data"] + 1  # bytes of a packet

MANUAL = struct.Struct("<B3fHB")
POSITION = struct.Struct("<B4f")
POSE = struct.Struct("<B7f")

CFLIB = ("radio://", "usb://", "serial://")


@dataclass(frozen=True)
class Packet:
    """One packet."""

    port: int
    channel: int
    data: bytes

    def pack(self) -> bytes:
        """Return the bytes to send."""
        return bytes([self.port << FACTS["header_shift"] | self.channel & 3]) + self.data


def message(port: str, channel: str, data: bytes) -> bytes:
    """Return the bytes of a packet; ``port`` and ``channel``: their names among the facts."""
    return Packet(FACTS[port], FACTS[channel], data).pack()


def unpack(data: bytes) -> Packet | None:
    """Return the packet in some bytes; None if they are not a packet."""
    if not 1 <= len(data) <= MOST:
        return None
    return Packet(data[0] >> FACTS["header_shift"], data[0] & 3, data[1:])


def manual(thrust: int, rates_dps: tuple[float, float, float]) -> bytes:
    """Return a manual set-point in rate mode: thrust, 0 to 65535, and body rates forward, left,
    up [deg/s].
    """
    axes = zip(rates_dps, ("roll", "pitch", "yaw"))
    signed = (FACTS[f"manual_{axis}_sign"] * rate for rate, axis in axes)
    data = MANUAL.pack(FACTS["manual"], *signed, thrust, FACTS["manual_rate"])
    return message("port_generic", "channel_set_point", data)


def position(place_w: tuple[float, ...], yaw_deg: float) -> bytes:
    """Return a position set-point [m], z up, with heading [deg], which the vehicle holds by
    itself.
    """
    data = POSITION.pack(FACTS["position"], *place_w, yaw_deg)
    return message("port_generic", "channel_set_point", data)


def external_pose(pos: tuple[float, ...], quat: tuple[float, ...]) -> bytes:
    """Return a packet with position [m], z up, and attitude xyzw for the vehicle's estimator."""
    data = POSE.pack(FACTS["external_pose"], *pos, *quat)
    return message("port_localization", "channel_pose", data)


def encode_name(name: str) -> bytes:
    """Return a parameter's name ``group.name`` as encoded in packets."""
    return name.replace(".", "\0").encode() + b"\0"


def set_parameter(name: str, value: int) -> bytes:
    """Return a packet that sets an eight-bit parameter by its name."""
    data = bytes([FACTS["set_by_name"]]) + encode_name(name) + bytes([FACTS["type_uint8"], value])
    return message("port_param", "channel_by_name", data)


def arm(on: bool) -> bytes:
    """Return the request to arm or disarm."""
    data = bytes([FACTS["arm"], on])
    return message("port_supervisor", "channel_command", data)


def ask_state() -> bytes:
    """Return the request for the supervisor's state."""
    return message("port_supervisor", "channel_info", bytes([FACTS["ask_state"]]))


def ask_protocol() -> bytes:
    """Return the request for the protocol's version."""
    return message("port_platform", "channel_version", bytes([FACTS["ask_protocol"]]))


class CflibPort(Port):
    """A radio or USB link of cflib."""

    whole = True

    def __init__(self, address: str):
        """Open the link. Raises `LinkError`: cflib is missing, or the link cannot be opened."""
        crtp = load_extra("cflib.crtp", "crazyflie", f"the Crazyflie at {address}", LinkError)
        self._packet = load_extra(
            "cflib.crtp.crtpstack", "crazyflie", "the Crazyflie", LinkError
        ).CRTPPacket
        self.lost: str | None = None
        try:
            crtp.init_drivers()
            self._open = crtp.get_link_driver(address, None, self._lose)
        except Exception as error:  # USB, and the package's own
            raise LinkError(f"cannot open {address}: {error}") from error
        if self._open is None:
            raise LinkError(
                f"cannot open {address}: no driver of cflib accepts it; expected"
                f" {', '.join(CFLIB)}..."
            )

    def _lose(self, message: str) -> None:
        self.lost = message

    def read(self) -> bytes | None:
        packet = self._open.receive_packet(0)
        return None if packet is None else bytes([packet.header]) + bytes(packet.data)

    def write(self, data: bytes, address: tuple[str, int] | None = None) -> bool:
        packet = self._packet(data[0])
        packet.data = data[1:]
        self._open.send_packet(packet)
        return self.lost is None

    def fileno(self) -> int:
        """Return -1: a thread receives the packets, so there is no file to wait for."""
        return -1


def open_crtp(device: str, remote: bool) -> Port:
    """Open the port of a device; raises `LinkError` where it is refused, or cannot be opened."""
    return (
        CflibPort(device)
        if device.startswith(CFLIB)
        else open_port(check_device(device, remote=remote), "--set crazyflie.device=...")
    )
