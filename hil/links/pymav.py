"""The one place that imports pymavlink, after MAVLink 2 was asked for."""

import os
from collections.abc import Callable

os.environ["MAVLINK20"] = "1"  # pymavlink speaks version 1 without it, which cannot carry ODOMETRY

from pymavlink.dialects.v20 import ardupilotmega as mav

__all__ = ["Parser", "mav"]

FORGED = "Invalid signature"  # what pymavlink calls a message without a valid signature, where one is asked for


class Parser:
    """Bytes to messages. No byte string makes it raise.

    Attributes:
        errors: byte strings that were no message, or only in part. forged: messages of the last bytes without a valid signature.
    """

    def __init__(self, make: Callable[[], mav.MAVLink] = lambda: mav.MAVLink(None)) -> None:
        """Take what makes pymavlink's parser, which may ask for signatures."""
        self.errors, self._make = 0, make
        self.forged: list[bytes] = []
        self._fresh()

    def _fresh(self) -> None:
        self._mav = self._make()
        self._mav.robust_parsing = True

    def parse(self, data: bytes, whole: bool = True) -> list:
        """Return messages in a byte string: a whole datagram, of which nothing is kept for the next one, or a piece of a stream."""
        self.forged = []
        try:
            found = self._mav.parse_buffer(data) or []
        except Exception:  # whatever pymavlink stumbles over, its state is not to be trusted afterwards
            self.errors += 1
            self._fresh()
            return []
        messages = [message for message in found if message.get_msgId() >= 0]
        self.errors += len(found) - len(messages)
        if len(found) > len(messages):
            bad = (message for message in found if message.get_msgId() < 0)
            self.forged = [bytes(message.data) for message in bad if getattr(message, "reason", "") == FORGED]
        if whole and self._mav.buf_len():
            self.errors += 1
            self._mav.buf, self._mav.buf_index, self._mav.expected_length = bytearray(), 0, mav.HEADER_LEN_V1 + 2
        return messages
