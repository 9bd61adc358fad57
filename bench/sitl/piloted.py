"""A pilot with a transmitter flies Betaflight in software, and hands over by MSP OVERRIDE."""

import socket
import struct
from typing import Any

import numpy as np

from hil.links import msp
from hil.links.backends.betaflight import HIGH, LOW, STICKS
from hil.links.backends.rates import MIDDLE, Sticks
from hil.links.facts import values
from hil.rehearsal.bridges.betaflight_bridge import BetaflightSitl

FACTS = values("betaflight")
RADIO = struct.Struct("<d16H")  # stamp, channels
FRAME = 0.02  # between two frames of the transmitter [s]
ARMS = 1.0  # when the pilot arms, the throttle low [s]
# channels of the switches
ARM = STICKS
OVERRIDE = STICKS + 1


class Piloted(BetaflightSitl):
    """A bridge beside which a pilot hovers the vehicle.

    Attributes:
        override: the pilot's switch. radio: channels of the last frame. firmware: channels as the
            firmware uses them: roll, pitch, yaw, throttle, AUX 1 and on.
    """

    def __init__(self, *args: Any, **kwargs: Any) -> None:
        super().__init__(*args, **kwargs)
        self.override = False
        self.radio: list[int] = []
        self.firmware: tuple[int, ...] = ()
        self._sticks = Sticks(self.params.rates)
        self._framed = -np.inf
        self._transmitter = socket.socket(socket.AF_INET, socket.SOCK_DGRAM)
        self._transmitter.connect(("127.0.0.1", FACTS["radio_port"]))

    def fly(self) -> None:
        if self.plant.time - self._framed >= FRAME:
            self._framed = self.plant.time
            self.radio = self._fly_by_hand()
            self._transmitter.send(RADIO.pack(self.plant.time, *self.radio))
        super().fly()

    def _fly_by_hand(self) -> list[int]:
        channels = [LOW] * 16
        thrust, *rates = self.hold(self._place) if self.armed else np.zeros(4)
        low = self.params.minimum_us
        throttle = round(low + self.params.thrust.share(thrust) * (HIGH - low))
        turns = [self._sticks.position(axis, rate) for axis, rate in enumerate(rates)]
        sticks = (*turns, throttle) if self.armed else (MIDDLE, MIDDLE, MIDDLE, LOW)
        for at, value in zip(FACTS["rcmap"], sticks):
            channels[at] = value
        channels[ARM] = HIGH if self.plant.time > ARMS else LOW
        channels[OVERRIDE] = HIGH if self.override else LOW
        return channels

    def _hear(self, frame: msp.Frame) -> None:
        super()._hear(frame)
        if frame.command == msp.RC:
            self.firmware = frame.words()

    def close(self) -> None:
        super().close()
        self._transmitter.close()
