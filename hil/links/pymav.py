"""The one place that imports pymavlink, after MAVLink 2 was asked for: a parser that never raises,
and signed messages.

A signature is the first six bytes of SHA-256 over key, message and a time stamp that only grows, so
that nothing can be sent again.

Source: mavlink.io, Message Signing (time stamps of 10 us since 2015-01-01; a new stream may be a
minute behind)."""

import hashlib
import hmac
import os
import stat
import struct
import time
from collections.abc import Callable
from pathlib import Path

from hil.errors import LinkError

os.environ["MAVLINK20"] = "1"  # pymavlink speaks version 1 without it, which cannot carry ODOMETRY

from pymavlink.dialects.v20 import ardupilotmega as mav

__all__ = ["Parser", "mav"]

FORGED = (  # what pymavlink calls a message without a valid signature, where one is asked for
    "Invalid signature"
)


class Parser:
    """Bytes to messages; no byte string makes it raise.

    ``errors`` counts what was no message, or only in part; ``forged`` are messages of the last
    bytes without a valid signature.
    """

    def __init__(self, make: Callable[[], mav.MAVLink] = lambda: mav.MAVLink(None)):
        """Take what makes pymavlink's parser, which may ask for signatures."""
        self.errors = 0
        self._make = make
        self.forged: list[bytes] = []
        self._fresh()

    def _fresh(self) -> None:
        self._mav = self._make()
        self._mav.robust_parsing = True

    def parse(self, data: bytes, whole: bool = True) -> list:
        """Return messages in a byte string: a whole datagram, of which nothing is kept for the next
        one, or a piece of a stream.
        """
        self.forged = []
        try:
            parsed = self._mav.parse_buffer(data) or []
        except Exception:  # pymavlink's state is not to be trusted afterwards
            self.errors += 1
            self._fresh()
            return []
        messages = [message for message in parsed if message.get_msgId() >= 0]
        self.errors += len(parsed) - len(messages)
        if len(parsed) > len(messages):
            bad = (message for message in parsed if message.get_msgId() < 0)
            self.forged = [
                bytes(message.data) for message in bad if getattr(message, "reason", "") == FORGED
            ]
        if whole and self._mav.buf_len():
            self.errors += 1
            self._fresh()
        return messages


SIGNATURE = struct.Struct("<B6s6s")  # at a message's end: link id, time [10 us], signature
KEY_BYTES = 32
TICKS = 100_000  # of a signature's time a second
EPOCH = 1_420_070_400.0  # 2015-01-01, where time stamps of signatures begin [s since 1970]
# that the first message of a stream may be behind our clock: a minute, in units of 10 us
LAG_LIMIT = 6_000_000
MOST_STREAMS = 256  # streams of valid signatures; more than 255 link ids of one sender are none
LEAST_WORD = 8  # characters of a pass phrase


def read_key(path: str | Path) -> bytes:
    """Read a key of 32 bytes: raw, as 64 hexadecimal digits, or by a pass phrase, whose SHA-256 it
    then is; raises `LinkError` for a file that cannot be read, that others may read, or that holds
    no key.
    """
    path = Path(path)
    try:
        data = path.read_bytes()
        mode = path.stat().st_mode
    except OSError as error:
        raise LinkError(
            f"key {path}: {error.strerror}; expected a file with a key for --sign"
        ) from error
    if mode & (stat.S_IRGRP | stat.S_IROTH):
        raise LinkError(f"key {path} can be read by others; expected: chmod 600 {path}")
    if len(data) == KEY_BYTES:
        return data
    word = data.strip()
    try:
        raw = bytes.fromhex(word.decode("ascii"))
    except (ValueError, UnicodeDecodeError):
        raw = b""
    if len(raw) == KEY_BYTES:
        return raw
    if len(word) < LEAST_WORD:
        raise LinkError(
            f"key {path}: {len(word)} characters; expected 32 bytes, 64 hexadecimal digits or a"
            f" phrase of {LEAST_WORD}"
        )
    return hashlib.sha256(word).digest()


def stamp_now() -> int:
    """Return the time as signatures have it [10 us]."""
    return int((time.time() - EPOCH) * TICKS)


class Signed(mav.MAVLink):
    """Packs signed messages, and parses those alone that are."""

    def __init__(
        self, key: bytes, system: int = 0, component: int = 0, streams: dict | None = None
    ):
        """Take a key of 32 bytes, ids of the sender, and times of the last valid signatures, of
        another parser of the same link.
        """
        super().__init__(None, system, component)
        self.signing.secret_key = key
        self.signing.sign_outgoing = True
        self.signing.stream_timestamps = {} if streams is None else streams
        self.touch()

    def touch(self) -> None:
        """Let the next signature bear the time, or one more than the last."""
        self.signing.timestamp = max(self.signing.timestamp, stamp_now())

    def check_signature(self, msgbuf: bytearray, srcSystem: int, srcComponent: int) -> bool:
        """Return whether a signature is valid, and newer than the last valid one of its stream.

        The library's own notes the time of a message before it has looked at the signature: one
        forged message with a late time would shut the true sender out."""
        link, units, signature = SIGNATURE.unpack(msgbuf[-SIGNATURE.size :])
        signed = bytes(msgbuf[: -len(signature)])
        good = hashlib.sha256(self.signing.secret_key + signed).digest()[: len(signature)]
        if not hmac.compare_digest(good, signature):
            return False
        stream = (link, srcSystem, srcComponent)
        last = self.signing.stream_timestamps
        stamp = int.from_bytes(units, "little")
        if stamp <= last.get(stream, stamp_now() - LAG_LIMIT) or (
            stream not in last and len(last) >= MOST_STREAMS
        ):
            return False
        last[stream] = stamp
        return True
