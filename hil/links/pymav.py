"""The only module that imports pymavlink, with MAVLink 2 selected: a parser that never raises, and
signed messages.

A signature is the first six bytes of SHA-256 over key, message and an increasing time stamp, which
prevents replays.

Source: mavlink.io, Message Signing (time stamps in units of 10 us since 2015-01-01; a new stream
may be a minute behind)."""

import hashlib
import hmac
import os
import stat
import struct
import time
from collections.abc import Callable
from pathlib import Path

from hil.errors import LinkError

os.environ["MAVLINK20"] = "1"  # default is version 1, without ODOMETRY

from pymavlink.dialects.v20 import ardupilotmega as mav

__all__ = ["Parser", "mav"]

FORGED = (  # pymavlink's reason for a message without a valid signature, if one is required
    "Invalid signature"
)


class Parser:
    """A parser of MAVLink messages that never raises.

    ``errors`` counts invalid and incomplete messages; ``forged`` holds the messages of the last
    call without a valid signature.
    """

    def __init__(self, make: Callable[[], mav.MAVLink] = lambda: mav.MAVLink(None)):
        """Use a factory of pymavlink's parser, which may require signatures."""
        self.errors = 0
        self._make = make
        self.forged: list[bytes] = []
        self._fresh()

    def _fresh(self) -> None:
        self._mav = self._make()
        self._mav.robust_parsing = True

    def parse(self, data: bytes, whole: bool = True) -> list:
        """Return the messages in some bytes: a whole datagram, after which nothing is kept for
        the next call, or a piece of a stream.
        """
        self.forged = []
        try:
            parsed = self._mav.parse_buffer(data) or []
        except Exception:  # pymavlink's state is unreliable afterwards
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
TICKS = 100_000  # units of a signature's time per second
EPOCH = 1_420_070_400.0  # 2015-01-01, where time stamps of signatures begin [s since 1970]
# by which the first message of a stream may be behind our clock: a minute, in units of 10 us
LAG_LIMIT = 6_000_000
MOST_STREAMS = 256  # most streams of valid signatures: one sender has up to 256 link ids
LEAST_WORD = 8  # least number of characters of a pass phrase


def read_key(path: str | Path) -> bytes:
    """Read a key of 32 bytes: raw, as 64 hexadecimal digits, or as a pass phrase, whose SHA-256
    is the key. Raises `LinkError`: the file cannot be read, others may read it, or it holds no
    key.
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
    """Return the current time in the unit of signatures [10 us]."""
    return int((time.time() - EPOCH) * TICKS)


class Signed(mav.MAVLink):
    """A MAVLink instance that packs signed messages, and accepts only signed ones."""

    def __init__(
        self, key: bytes, system: int = 0, component: int = 0, streams: dict | None = None
    ):
        """Set the key of 32 bytes, the sender's ids, and ``streams``: times of the last valid
        signatures, shared with other parsers of the link.
        """
        super().__init__(None, system, component)
        self.signing.secret_key = key
        self.signing.sign_outgoing = True
        self.signing.stream_timestamps = {} if streams is None else streams
        self.touch()

    def touch(self) -> None:
        """Set the time stamp of the next signature to the current time, if that is later."""
        self.signing.timestamp = max(self.signing.timestamp, stamp_now())

    def check_signature(self, msgbuf: bytearray, srcSystem: int, srcComponent: int) -> bool:
        """Return whether a signature is valid and newer than the last valid one of its stream.

        The library's own method stores the time of a message before it checks the signature, so one
        forged message with a late time would lock out the true sender."""
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
