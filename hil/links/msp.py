"""MSP, the serial protocol of Betaflight: frames of version 1 and 2 to bytes and back.

Version 1: ``$M``, direction, length, command, payload, XOR of length to payload. Version 2: ``$X``, direction, flag, command and
length of two bytes each, payload, CRC-8/DVB-S2 of flag to payload. Directions: ``<`` to the flight controller, ``>`` its answer,
``!`` its refusal. Numbers are little-endian.

Source: betaflight, src/main/msp/msp_serial.c and msp_protocol.h.
"""

import struct
from dataclasses import dataclass

API_VERSION, FC_VARIANT, MODE_RANGES, FEATURE_CONFIG, RX_CONFIG, RX_MAP, FAILSAFE_CONFIG = 1, 2, 34, 36, 44, 64, 75
STATUS, SERVO, RC, ANALOG, RC_TUNING, BOXIDS, RC_DEADBAND = 101, 103, 105, 110, 111, 119, 125
SET_RAW_RC, SET_RC_TUNING, EEPROM_WRITE = 200, 204, 250
"""Command numbers."""

TO_CONTROLLER, ANSWER, REFUSAL = b"<", b">", b"!"
MOST_PAYLOAD = 1024
"""A longer one is no frame; answers that are used here have some forty bytes."""


@dataclass(frozen=True)
class Frame:
    """One message."""

    command: int
    payload: bytes = b""
    direction: bytes = TO_CONTROLLER
    version: int = 1

    def u8(self, at: int) -> int | None:
        """Byte at a place; None beyond the end."""
        return self.payload[at] if 0 <= at < len(self.payload) else None

    def u16(self, at: int) -> int | None:
        """Two bytes at a place; None beyond the end."""
        return self._number("<H", at)

    def u32(self, at: int) -> int | None:
        """Four bytes at a place; None beyond the end."""
        return self._number("<I", at)

    def _number(self, code: str, at: int) -> int | None:
        try:
            return struct.unpack_from(code, self.payload, at)[0]
        except struct.error:
            return None

    def words(self) -> tuple[int, ...]:
        """The payload as numbers of two bytes; an odd last byte is left out."""
        return struct.unpack_from(f"<{len(self.payload) // 2}H", self.payload)


def pack(frame: Frame) -> bytes:
    """Bytes of a frame.

    Raises:
        ValueError: command or payload are too large for the version.
    """
    count = len(frame.payload)
    if frame.version == 1:
        if not (0 <= frame.command <= 255 and count <= 254):  # 255 marks a jumbo frame
            raise ValueError(f"MSP 1: command {frame.command} with {count} bytes; expected at most 255, and 254 bytes")
        body = bytes([count, frame.command]) + frame.payload
        return b"$M" + frame.direction + body + bytes([xor(body)])
    if not (0 <= frame.command <= 65535 and count <= MOST_PAYLOAD):
        raise ValueError(f"MSP 2: command {frame.command} with {count} bytes; expected at most 65535, and {MOST_PAYLOAD} bytes")
    body = struct.pack("<BHH", 0, frame.command, count) + frame.payload
    return b"$X" + frame.direction + body + bytes([crc8(body)])


def xor(data: bytes) -> int:
    """Checksum of version 1."""
    out = 0
    for byte in data:
        out ^= byte
    return out


def crc8(data: bytes) -> int:
    """CRC-8/DVB-S2, polynomial 0xD5: checksum of version 2."""
    out = 0
    for byte in data:
        out ^= byte
        for _ in range(8):
            out = (out << 1 ^ 0xD5) & 0xFF if out & 0x80 else out << 1
    return out


class Parser:
    """Bytes of a stream to frames. No byte string makes it raise.

    Attributes:
        errors: places where something looked like a frame and was none.
    """

    def __init__(self) -> None:
        """Start empty."""
        self.errors = 0
        self._buffer = bytearray()

    def parse(self, data: bytes) -> list[Frame]:
        """Frames that are complete by now."""
        self._buffer += data
        frames = []
        while True:
            start = self._buffer.find(b"$")
            if start < 0:
                self._buffer.clear()
                return frames
            del self._buffer[:start]
            length = self._length()
            if length is None or (length and len(self._buffer) < length):
                return frames  # more is to come
            frame = self._frame(length) if length else None
            if frame is None:
                self.errors += 1
                del self._buffer[:1]  # look for the next beginning right behind this one
            else:
                frames.append(frame)
                del self._buffer[:length]

    def _length(self) -> int | None:
        """Length of the frame that begins the buffer; None: not known yet, 0: there is none."""
        b = self._buffer
        if (len(b) > 1 and b[1] not in b"MX") or (len(b) > 2 and b[2] not in b"<>!"):
            return 0
        if len(b) < 4 or (b[1] == ord("X") and len(b) < 8):
            return None
        if b[1] == ord("M"):
            return 6 + b[3]
        count = struct.unpack_from("<H", b, 6)[0]
        return 9 + count if count <= MOST_PAYLOAD else 0

    def _frame(self, length: int) -> Frame | None:
        b = bytes(self._buffer[:length])
        if b[1] == ord("M"):
            good, command, payload = xor(b[3:-1]) == b[-1], b[4], b[5:-1]
        else:
            good, command, payload = crc8(b[3:-1]) == b[-1], struct.unpack_from("<H", b, 4)[0], b[8:-1]
        return Frame(command, payload, b[2:3], 1 if b[1] == ord("M") else 2) if good else None
