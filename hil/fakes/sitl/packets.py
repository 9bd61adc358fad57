"""Betaflight's packets between firmware and simulator: samples of the sensors in, motor outputs out.

Convention: the firmware wants rates forward, right, down; the negative of the specific force forward, left, up; the attitude
w, x, y, z of forward, left, up in north, west, up. It answers every packet of samples with one of motors, in the order front
right, rear left, front left, rear right.

The firmware's clock goes at wall time times a rate, the ratio of the last two stamps' difference to that of their arrivals where
the former lies between 0 and 20 ms. So stamps that stand still leave the rate as it is, and no jitter of the machine reaches the
firmware's clock; two stamps set it (`Sensors.start`). Stamps that go with the simulation would make its clock leap whenever
two packets come close to each other.

Source: betaflight 4.6, src/platform/SIMULATOR/sitl.c (updateState, micros64, pwmCompleteMotorUpdate) and target/SITL/target.h.
"""

import socket
import struct
import threading
import time

import numpy as np

from hil.errors import RunError

GRAVITY = 9.80665
"""Of the firmware's accelerometer [m/s^2]."""

MOTORS, SENSORS = 9002, 9003
"""UDP ports: motor outputs come there, samples go there."""

FDM = struct.Struct("<18d")
"""Stamp, rates (3), acceleration (3), attitude (4), velocity (3), position (3), pressure."""

PWM = struct.Struct("<4f")

OURS = (2, 0, 1, 3)
"""Where front left, front right, rear left, rear right stand in the packet of motors."""

SEA_LEVEL = 101325.0
"""[Pa]"""

STILL, CALIBRATION = 0.002, 3.0
"""Between two packets at rest, and the time that the firmware's gyro takes to be calibrated and its receiver to begin [s]."""

GAP, MOST_GAP = 0.018, 0.0199
"""Firmware time between the two stamps that set its clock's rate, and the most that counts [s]."""

TRIES = 20
"""Of two stamps less than that apart."""


def samples(stamp: float, rate_b: np.ndarray, force_b: np.ndarray, quat_wb: np.ndarray) -> bytes:
    """Packet of body rates [rad/s], specific force [m/s^2], shapes (3,), body frame, and attitude xyzw, shape (4,)."""
    x, y, z, w = quat_wb
    return FDM.pack(
        stamp, rate_b[0], -rate_b[1], -rate_b[2], *(-force_b), w, x, y, z, 0.0, 0.0, 0.0, 0.0, 0.0, 0.0, SEA_LEVEL
    )  # fmt: skip


def motors(packet: bytes) -> np.ndarray | None:
    """Motor outputs, 0 to 1, shape (4,), in our order; None where the packet holds none."""
    if len(packet) != PWM.size:
        return None
    values = PWM.unpack(packet)
    return np.array([values[at] for at in OURS])


class Sensors:
    """Where samples are sent to."""

    def __init__(self) -> None:
        """Open a socket."""
        self._socket = socket.socket(socket.AF_INET, socket.SOCK_DGRAM)
        self._stamp = 1.0
        self._last: tuple[np.ndarray, ...] = (np.zeros(3), np.array([0.0, 0.0, GRAVITY]), np.array([0.0, 0.0, 0.0, 1.0]))

    def send(self, rate_b: np.ndarray, force_b: np.ndarray, quat_wb: np.ndarray) -> None:
        """Send samples; see `samples`."""
        self._last = (rate_b, force_b, quat_wb)
        self._socket.sendto(samples(self._stamp, *self._last), ("127.0.0.1", SENSORS))

    def start(self, rate: float) -> None:
        """Let the firmware calibrate its sensors, and its clock go at a rate of wall time; the vehicle stands still meanwhile.

        Raises:
            RunError: the machine is too busy for the clock to be set.
        """
        for _ in range(round(CALIBRATION / STILL)):
            self.send(*self._last)
            time.sleep(STILL)
        for _ in range(TRIES if rate != 1.0 else 0):
            began = time.monotonic()
            time.sleep(GAP / rate)
            passed = rate * (time.monotonic() - began)
            if passed < MOST_GAP:
                self._stamp += passed
                self.send(*self._last)
                return
            self.send(*self._last)  # slept too long: the same stamp again, from which the next try begins
        if rate != 1.0:
            raise RunError(f"the machine sleeps longer than it is told to, {TRIES} times in a row; expected a quieter one")

    def close(self) -> None:
        """Give the socket back."""
        self._socket.close()


class StillSensors:
    """A vehicle at rest, while nothing flies yet: the firmware calibrates its gyro and answers only with samples."""

    def __enter__(self) -> "StillSensors":
        self._done, self._sensors = threading.Event(), Sensors()
        self._thread = threading.Thread(target=self._feed, daemon=True)
        self._thread.start()
        return self

    def _feed(self) -> None:
        while not self._done.wait(STILL):
            self._sensors.send(*self._sensors._last)

    def __exit__(self, *_: object) -> None:
        self._done.set()
        self._thread.join()
        self._sensors.close()
