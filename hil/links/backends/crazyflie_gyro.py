"""The stream of body rates that a Crazyflie's logging sends.

Its variables have numbers that differ from build to build: they are looked up by name in its table
of contents, put into a block, and the block is started. All of it happens on the ground.

Source: `hil.links.facts`, crazyflie, Logging."""

import math
import struct
from collections.abc import Callable

from hil.links.crtp import message
from hil.links.facts import values

FACTS = values("crazyflie")
NAMES = [f"gyro\0{axis}\0".encode() for axis in FACTS["log_gyro"]]
BLOCK = 239  # ours among the blocks of others
PERIOD_MS = 20  # between two of our blocks [ms]
AT_ONCE = 8  # questions for variables that are out at a time
ASK_AGAIN = 0.1  # for an answer that did not come [s]
RATES = struct.Struct("<3f")
ITEM = struct.Struct("<BHB")
STAMP = 4  # bytes of block and time before the values


class GyroStream:
    """Body rates that the vehicle reports.

    Attributes:
        rates: the newest [rad/s], x forward, y left, z up; None before any came, and where the
            firmware has no such variables.
    """

    def __init__(self, put: Callable[[bytes], bool]):
        """Ask by ``put``, which takes a packet's bytes."""
        self._put = put
        self.rates: tuple[float, ...] | None = None
        self._count: int | None = None  # of the vehicle's variables
        self._next = 0  # the first variable whose name is not known
        self._numbers: dict[bytes, int] = {}
        self._created = False
        self._asked = -math.inf
        self._asked_for = None

    def service(self, host_time: float) -> None:
        """Ask for the next step, again where its answer did not come."""
        step = (self._count, self._next, self._created)
        waits = step == self._asked_for and host_time - self._asked < ASK_AGAIN
        if waits or self.rates is not None:
            return
        self._asked = host_time
        self._asked_for = step
        if self._count is None:
            self._send("log_contents", bytes([FACTS["log_info"]]))
        elif self._created:
            start = struct.pack("<BBH", FACTS["log_start"], BLOCK, PERIOD_MS)
            self._send("log_control", start)
        elif len(self._numbers) == len(NAMES):
            pairs = [struct.pack("<BH", FACTS["log_float"], self._numbers[n]) for n in NAMES]
            self._send("log_control", bytes([FACTS["log_create"], BLOCK]) + b"".join(pairs))
        else:
            for number in range(self._next, min(self._next + AT_ONCE, self._count)):
                self._send("log_contents", struct.pack("<BH", FACTS["log_item"], number))

    def _send(self, channel: str, data: bytes) -> None:
        self._put(message("port_log", channel, data))

    def hear(self, channel: int, data: bytes) -> None:
        """Take a packet of the logging port."""
        if channel == FACTS["log_contents"]:
            self._hear_contents(data)
        elif channel == FACTS["log_control"] and data[:2] == bytes([FACTS["log_create"], BLOCK]):
            self._created |= data[2] in (0, FACTS["log_exists"])
        elif channel == FACTS["log_data"] and data[0] == BLOCK and len(data) == STAMP + RATES.size:
            rates = tuple(map(math.radians, RATES.unpack_from(data, STAMP)))
            self.rates = rates if all(map(math.isfinite, rates)) else None

    def _hear_contents(self, data: bytes) -> None:
        if data[0] == FACTS["log_info"]:
            self._count = int.from_bytes(data[1:3], "little")
        elif data[0] == FACTS["log_item"] and len(data) > ITEM.size:
            _, number, _ = ITEM.unpack_from(data)
            self._next += number == self._next  # those behind a lost answer are asked for again
            if data[ITEM.size :] in NAMES:
                self._numbers[data[ITEM.size :]] = number
