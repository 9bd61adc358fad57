"""Byte level of Betaflight's blackbox: variable-length integers and packed groups of fields.

Source: Betaflight, "Blackbox logging internals" (docs/development/Blackbox Internals.md), data
version 2."""

from collections.abc import Callable
from itertools import takewhile

import numpy as np

SIGNED_VB = 0
UNSIGNED_VB = 1
NEG_14BIT = 3
TAG8_8SVB = 6
TAG2_3S32 = 7
TAG8_4S16 = 8
NULL = 9
TAG2_3SVARIABLE = 10
# encoding -> largest number of fields packed together
_GROUP = {TAG8_8SVB: 8, TAG2_3S32: 3, TAG8_4S16: 4, TAG2_3SVARIABLE: 3}

_LONGEST_VB = 5  # bytes of a 32-bit number, seven bits a byte


class EndOfLog(Exception):
    """The bytes end within a frame."""


class Corrupt(Exception):
    """The bytes do not follow the format."""


class Reader:
    """A position in the bytes of one log."""

    def __init__(self, data: bytes, pos: int = 0):
        """Create a reader at byte ``pos``."""
        self.data = data
        self.pos = pos
        self.end = len(data)

    def byte(self) -> int:
        """Read a byte. Raises EndOfLog: there is none."""
        if self.pos >= self.end:
            raise EndOfLog
        self.pos += 1
        return self.data[self.pos - 1]

    def unsigned(self) -> int:
        """Read an unsigned variable-length number, low bits first. Raises Corrupt: it is longer
        than 32 bits.
        """
        value = 0
        for shift in range(0, 7 * _LONGEST_VB, 7):
            byte = self.byte()
            value |= (byte & 0x7F) << shift
            if byte < 0x80:
                return value & 0xFFFFFFFF
        raise Corrupt

    def signed(self) -> int:
        """Read a signed variable-length number in zig-zag encoding."""
        value = self.unsigned()
        return (value >> 1) ^ -(value & 1)

    def little(self, size: int) -> int:
        """Read a signed little-endian number of ``size`` bytes."""
        return extend(sum(self.byte() << (8 * i) for i in range(size)), 8 * size)

    def float32(self) -> float:
        """Read a little-endian float of 32 bits."""
        return float(np.frombuffer(bytes(self.byte() for _ in range(4)), "<f4")[0])


Decoder = Callable[[Reader, int], list[int]]
"""A function that reads a number of fields at once."""


def extend(value: int, bits: int) -> int:
    """Interpret the lowest ``bits`` of a value as a two's complement number."""
    value &= (1 << bits) - 1
    return value - (1 << bits) if value >> (bits - 1) else value


def _tag8_8svb(r: Reader, count: int) -> list[int]:
    if count == 1:  # one field alone has no tag
        return [r.signed()]
    tag = r.byte()
    return [r.signed() if tag >> i & 1 else 0 for i in range(count)]


def _three(one: tuple, two: tuple) -> Decoder:
    """Return a decoder of three fields. The two highest bits of the first byte select the layout:
    one byte, ``one`` or ``two`` more bytes (shift and width of each field), or whole bytes.
    """
    places = (((4, 2), (2, 2), (0, 2)), one, two)

    def decode(r: Reader, count: int) -> list[int]:
        bits = r.byte()
        selector = bits >> 6
        if selector == 3:
            return [r.little((bits >> shift & 3) + 1) for shift in (0, 2, 4)]
        for _ in range(selector):
            bits = bits << 8 | r.byte()
        return [extend(bits >> shift, width) for shift, width in places[selector]]

    return decode


def _tag8_4s16(r: Reader, count: int) -> list[int]:
    """Read four fields of 0, 4, 8 or 16 bits each, packed by nibbles."""
    tag = r.byte()
    values = []
    pending = 0  # bits read and not used yet
    have = 0  # their number
    for i in range(4):
        need = (0, 4, 8, 16)[tag >> (2 * i) & 3]
        while have < need:
            pending = pending << 8 | r.byte()
            have = have + 8
        have -= need
        values.append(extend(pending >> have, need) if need else 0)
        pending &= (1 << have) - 1
    return values


DECODERS: dict[int, Decoder] = {
    SIGNED_VB: lambda r, n: [r.signed()],
    UNSIGNED_VB: lambda r, n: [r.unsigned()],
    NEG_14BIT: lambda r, n: [-extend(r.unsigned(), 14)],
    NULL: lambda r, n: [0],
    TAG8_8SVB: _tag8_8svb,
    TAG2_3S32: _three(((8, 4), (4, 4), (0, 4)), ((16, 6), (8, 6), (0, 6))),
    TAG8_4S16: _tag8_4s16,
    TAG2_3SVARIABLE: _three(((9, 5), (4, 5), (0, 4)), ((14, 8), (7, 7), (0, 7))),
}


def plan(encodings: list[int], skipped: list[bool]) -> list[tuple[Decoder, int, int]]:
    """Group fields that are packed together, by the encoding of each field.

    ``skipped``: fields without bytes (those incremented by one). Returns decoder, first field and
    number of fields of each group.
    """
    groups = []
    i = 0
    while i < len(encodings):
        if skipped[i]:
            i += 1
            continue
        code = encodings[i]
        together = encodings[i : i + _GROUP.get(code, 1)]
        if code == TAG8_8SVB:
            together = list(takewhile(code.__eq__, together))
        groups.append((DECODERS[code], i, len(together)))
        i += len(together)
    return groups
