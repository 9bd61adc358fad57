"""MSP, the serial protocol of Betaflight: encoder and parser of frames of version 1.

The firmware answers in the version of the request. A frame is ``$M``, direction, length, command,
payload, and XOR of length to payload. Directions: ``<`` to the flight controller, ``>`` its answer,
``!`` its refusal. Numbers are little-endian.

Source: betaflight, src/main/msp/msp_serial.c and msp_protocol.h.
"""

import operator
import struct
from dataclasses import dataclass
from functools import reduce

from hil.links.facts import values

FACTS = values("betaflight")
MODE_RANGES = FACTS["MSP_MODE_RANGES"]
RX_MAP = FACTS["MSP_RX_MAP"]
STATUS = FACTS["MSP_STATUS"]
RAW_IMU = FACTS["MSP_RAW_IMU"]
SERVO = FACTS["MSP_SERVO"]
RC = FACTS["MSP_RC"]
ANALOG = FACTS["MSP_ANALOG"]
RC_TUNING = FACTS["MSP_RC_TUNING"]
BOXIDS = FACTS["MSP_BOXIDS"]
SET_RAW_RC = FACTS["MSP_SET_RAW_RC"]
SET_RC_TUNING = FACTS["MSP_SET_RC_TUNING"]
EEPROM_WRITE = FACTS["MSP_EEPROM_WRITE"]

TO_CONTROLLER = b"<"
ANSWER = b">"
REFUSAL = b"!"
MOST_PAYLOAD = FACTS["jumbo"] - 1  # the answers used here have some forty bytes
START = FACTS["frame_start"]  # of the bytes in the checksum
HEAD = START + 2  # bytes before the payload


@dataclass(frozen=True)
class Frame:
    """One message."""

    command: int
    payload: bytes = b""
    direction: bytes = TO_CONTROLLER

    def number(self, code: str, at: int) -> int | None:
        """Return the number at an offset, with a format code of `struct`; None beyond the end."""
        try:
            return struct.unpack_from(code, self.payload, at)[0]
        except struct.error:
            return None

    def words(self) -> tuple[int, ...]:
        """Return the payload as 16-bit numbers; an odd last byte is left out."""
        return struct.unpack_from(f"<{len(self.payload) // 2}H", self.payload)


def pack(frame: Frame) -> bytes:
    """Return the bytes of a frame. Raises `ValueError`: command or payload is too large."""
    count = len(frame.payload)
    if not (0 <= frame.command <= 255 and count <= MOST_PAYLOAD):
        raise ValueError(
            f"MSP 1: command {frame.command} with {count} bytes; expected at most 255, and"
            f" {MOST_PAYLOAD} bytes"
        )
    body = bytes([count, frame.command]) + frame.payload
    return b"$M" + frame.direction + body + bytes([xor(body)])


def xor(data: bytes) -> int:
    """Return the XOR checksum of bytes."""
    return reduce(operator.xor, data, 0)


class FrameParser:
    """A parser of frames in a stream of bytes.

    It never raises; ``errors`` counts apparent frames that were invalid.
    """

    def __init__(self) -> None:
        self.errors = 0
        self._buffer = bytearray()

    def parse(self, data: bytes) -> list[Frame]:
        """Add bytes; return the frames that they complete."""
        buffer = self._buffer
        frames = []
        buffer += data
        while (start := buffer.find(b"$")) >= 0:
            del buffer[:start]
            if buffer[1:2] in (b"", b"M") and (len(buffer) < 3 or buffer[2] in b"<>!"):
                if len(buffer) <= START or len(buffer) <= (end := HEAD + buffer[START]):
                    return frames  # incomplete
                if xor(buffer[START:end]) == buffer[end]:
                    payload = bytes(buffer[HEAD:end])
                    frames.append(Frame(buffer[START + 1], payload, bytes(buffer[2:3])))
                    del buffer[: end + 1]
                    continue
            self.errors += 1
            del buffer[:1]  # look for the next start after this byte
        buffer.clear()
        return frames
