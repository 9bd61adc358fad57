"""The stream of body rates from a Crazyflie's logging.

The numbers of logging variables differ from build to build. So the variables are looked up by name
in the table of contents and put into a block, which is then started, all on the ground.

Source: `hil.links.facts`, crazyflie, Logging."""

import math
import struct
from collections.abc import Callable

from hil.links.crtp import message
from hil.links.facts import values

FACTS = values("crazyflie")
NAMES = [f"gyro\0{axis}\0".encode() for axis in FACTS["log_gyro"]]
BLOCK = 239  # number of the runner's block
PERIOD_MS = 20  # between two messages of the block [ms]
AT_ONCE = 8  # requests for variables that are sent at a time
ASK_AGAIN = 0.1  # time after which a missing answer is requested again [s]
RATES = struct.Struct("<3f")
ITEM = struct.Struct("<BHB")
STAMP = 4  # bytes of block and time before the values


class GyroStream:
    """A reader of the body rates that the vehicle reports.

    Attributes:
        rates: newest [rad/s], x forward, y left, z up; None before the first, and for firmware
            without these variables.
    """

    def __init__(self, put: Callable[[bytes], bool]):
        """Send requests by ``put``, which takes a packet's bytes."""
        self._put = put
        self.rates: tuple[float, ...] | None = None
        self._count: int | None = None  # of the vehicle's variables
        self._next = 0  # first variable whose name is unknown
        self._numbers: dict[bytes, int] = {}
        self._created = False
        self._asked = -math.inf
        self._asked_for = None

    def service(self, host_time: float) -> None:
        """Request the next step, again if its answer is missing."""
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
        """Process a packet of the logging port."""
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
            self._next += number == self._next  # variables after a lost answer are requested again
            if data[ITEM.size :] in NAMES:
                self._numbers[data[ITEM.size :]] = number
