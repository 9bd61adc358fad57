"""Random byte strings and messages for the tests of links, each drawn from a recorded seed."""

import numpy as np
from pymavlink.generator.mavcrc import x25crc

from hil.links.pymav import mav

SEEDS, EACH = tuple(range(1, 11)), 100_000
"""Of the long tests: ten seeds of a hundred thousand each make the million, and run side by side.

Seed 0 is the short tests'.
"""


KINDS = tuple(sorted(mav.mavlink_map))
"""Numbers of all messages of the dialect."""


def frame_message(kind, body: bytes, ids: tuple[int, int] = (1, 1)) -> bytes:
    """A message with the vehicle's ids and a right checksum over any content, so that its fields
    reach the listeners.
    """
    number = kind.id
    head = bytes([len(body), 0, 0, 0, *ids])
    head += bytes([number & 255, number >> 8 & 255, number >> 16 & 255])
    crc = x25crc(head + body + bytes([kind.crc_extra]))
    return bytes([mav.PROTOCOL_MARKER_V2]) + head + body + crc.crc.to_bytes(2, "little")


def any_message(
    rng: np.random.Generator, kinds: tuple[int, ...] = KINDS, ids: tuple[int, int] = (1, 1)
) -> bytes:
    """A message of one of the kinds with any bits in its fields."""
    kind = mav.mavlink_map[kinds[rng.integers(len(kinds))]]
    return frame_message(kind, rng.bytes(kind.unpacker.size), ids)


def noise(rng: np.random.Generator) -> bytes:
    """Up to 300 random bytes."""
    return rng.bytes(int(rng.integers(0, 300)))


def mutate(rng: np.random.Generator, good: list[bytes]) -> bytes:
    """Return one of some messages with up to five bytes changed, cut, or run together
    with another.
    """
    data = bytearray(good[rng.integers(len(good))])
    for _ in range(int(rng.integers(0, 6))):
        data[rng.integers(len(data))] = rng.integers(256)
    if rng.random() < 0.3:
        data = data[: rng.integers(len(data))]
    if rng.random() < 0.3:
        data += good[rng.integers(len(good))]
    return bytes(data)
