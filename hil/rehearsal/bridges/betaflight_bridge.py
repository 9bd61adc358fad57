"""The bridge:

Betaflight's firmware flies the simulator's vehicle, rope and ball by its own motor outputs.

Each period of the vehicle the firmware gets gyro, accelerometer and attitude, and answers with four
motor commands. The release is read from the firmware's own channels by MSP on its second serial
port. The runner speaks to the first one; the bridge sends the poses of both bodies beside it. Until
the rotors carry it the vehicle hangs in a stand."""

import math
from typing import Any

import numpy as np
from numpy import ndarray

from hil.links import msp
from hil.links.backends.betaflight import (
    ARRIVED,
    BOX_ARM,
    FACTS,
    HIGH,
    STICKS,
    BetaflightParams,
    is_on,
)
from hil.links.device import Device, TcpPort, chunks
from hil.rehearsal.bridges.betaflight_firmware import PORTS
from hil.rehearsal.bridges.packets import Sensors
from hil.rehearsal.fake import Bridge, WirePlant
from hil.rehearsal.fake_mocap import SLACK

ASK = {msp.RC: 0.002, msp.STATUS: 0.1}  # what the firmware is asked for, and how often [s]

SAMPLE = 0.0005
"""Between two samples of the sensors [s]: 2000 a second for loops of 8 kHz.

Of one sample in 2 ms, held so long, the firmware's D is a spike, and motors taken at the first loop
after each sample miss 17 % of it and see the gyro 1.2 ms later.
"""

SLOW = 0.01  # share of late periods above which the machine is too slow for real time


class MotorPlant(WirePlant):
    """The vehicle behind the firmware: it steps under motor commands."""

    held: bool
    quat_wb: ndarray
    rate_b: ndarray
    force_b: ndarray
    voltage: float
    touchdown: float | None


class BetaflightSitl(Bridge):
    """See the head of this module; ``motors``: outputs, 0 to 1, mean of the last period, shape
    (4,), in our order; ``answered``: periods in which the firmware put out motors.
    """

    plant: MotorPlant
    params: BetaflightParams

    def connect(self, stands: int) -> None:
        """Connect to a firmware that runs; ``stands``: see `Sensors`."""
        self.armed = False
        self.port = TcpPort(Device("tcp", "127.0.0.1", PORTS[1]))
        self.sensors = Sensors(stands)
        self._parser = msp.FrameParser()
        self._asked = dict.fromkeys(ASK, -1e9)
        self._boxes: tuple[int, ...] = ()
        self.motors = np.zeros(4)
        self.answered = 0
        self.cycles: list[int] = []
        self._outputs: list[ndarray] = []
        self._samples = round(self.plant.period / SAMPLE)
        self._rate_b = self.plant.rate_b  # at the beginning of the last period
        self._sent = 0  # samples in this one

    def run_on(self, when: float) -> None:
        """Send samples by the rates at the period's beginning and their last change."""
        plant = self.plant
        step = self.plant.period / self._samples
        due = np.arange(
            self._sent,
            min(max(math.ceil((when - SLACK - plant.time) / step), self._sent), self._samples),
        )
        if len(due):
            rates_b = plant.rate_b + due[:, None] * ((plant.rate_b - self._rate_b) / self._samples)
            self._outputs.append(self.sensors.send(rates_b, plant.force_b, plant.quat_wb, step))
            self._sent += len(due)

    def fly(self) -> None:
        self.run_on(self.plant.time + self.plant.period)
        self._rate_b = self.plant.rate_b
        self._sent = 0
        super().fly()

    def hear(self) -> None:
        super().hear()
        for data in chunks(self.port):
            self.heard = self.wall()
            for frame in self._parser.parse(data):
                self._hear(frame)

    def _hear(self, frame: msp.Frame) -> None:
        if frame.command == msp.BOXIDS:
            self._boxes = tuple(frame.payload)
        elif frame.command == msp.STATUS and self._boxes:
            self._hear_status(frame)
        elif frame.command == msp.RC:
            channels = frame.words()
            at = STICKS + self.params.release_channel - 1
            self.output(at < len(channels) and abs(channels[at] - HIGH) <= ARRIVED, self.heard)

    def _hear_status(self, frame: msp.Frame) -> None:
        flags = frame.number("<I", FACTS["status_flags"]) or 0
        cycle = frame.number("<H", 0)
        armed = is_on(BOX_ARM, self._boxes, flags)
        if armed != self.armed:
            self.note_event("armed" if armed else "disarmed")
        self.armed = armed
        if armed and cycle:
            self.cycles.append(cycle)

    def compute_command(self) -> ndarray:
        came = np.concatenate(self._outputs)
        self._outputs = []
        if len(came):
            self.motors = came.mean(axis=0, dtype=float)
            self.answered += 1
        return self.motors

    def speak(self) -> None:
        plant = self.plant
        for command, period in ASK.items():
            if plant.time - self._asked[command] >= period:
                self._asked[command] = plant.time
                self.port.write(msp.pack(msp.Frame(command)))
        if not self._boxes and self._asked[msp.STATUS] == plant.time:
            self.port.write(msp.pack(msp.Frame(msp.BOXIDS)))

    def report(self) -> dict[str, Any]:
        loop = float(np.median(self.cycles)) if self.cycles else None
        return super().report() | {
            "held": self.plant.held,
            "motor_packets": self.answered,
            "loop_us": loop,
        }

    def close(self) -> None:
        super().close()
        for port in (self.port, self.sensors):
            port.close()
