"""Betaflight's packets between firmware and simulator: samples of the sensors in, motor outputs out.

Convention: the firmware wants rates forward, right, down; the negative of the specific force forward, left, up; the attitude
w, x, y, z of forward, left, up in north, west, up. It answers every packet of samples with one of motors, in the order front
right, rear left, front left, rear right.

A stamp says up to when the firmware may run (``lockstep.c``).

Source: betaflight 4.6, src/platform/SIMULATOR/sitl.c (updateState, micros64, pwmCompleteMotorUpdate) and target/SITL/target.h.
"""

import os
import select
import socket
import struct
import threading

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

PATIENCE = 10.0
"""For the firmware to come to a stamp [s], on the wall's clock: a tenth of a millisecond is usual."""


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


def stood(stands: int, most: float) -> bool:
    """Whether a firmware in lock step says on its pipe, within a time [s], that it stands still."""
    return bool(select.select([stands], [], [], most)[0]) and bool(os.read(stands, 8))


class Sensors:
    """Where samples are sent to, and the firmware's clock."""

    def __init__(self, stands: int | None = None) -> None:
        """Open a socket.

        Args:
            stands: pipe on which the firmware says that it has come to a stamp; None for one that runs by itself.
        """
        self._socket = socket.socket(socket.AF_INET, socket.SOCK_DGRAM)
        self._stands, self._stamp = stands, 0.0
        self._last: tuple[np.ndarray, ...] = (np.zeros(3), np.array([0.0, 0.0, GRAVITY]), np.array([0.0, 0.0, 0.0, 1.0]))

    def send(self, rate_b: np.ndarray, force_b: np.ndarray, quat_wb: np.ndarray, period: float) -> None:
        """Send samples, see `samples`, let the firmware run for a period [s], and wait until it has.

        Raises:
            RunError: it does not.
        """
        self._last = (rate_b, force_b, quat_wb)
        self._stamp += period
        self._socket.sendto(samples(self._stamp, *self._last), ("127.0.0.1", SENSORS))
        if self._stands is not None and not stood(self._stands, PATIENCE):
            raise RunError(f"the firmware has not come to the time {self._stamp:.3f} s of its samples after {PATIENCE:g} s")

    def rest(self, period: float) -> None:
        """The same with a vehicle that stands still, as at the last time."""
        self.send(*self._last, period)

    def start(self) -> None:
        """Let the firmware calibrate its sensors, the vehicle standing still.

        Raises:
            RunError: see `send`.
        """
        for _ in range(round(CALIBRATION / STILL)):
            self.rest(STILL)

    def close(self) -> None:
        """Give the socket back."""
        self._socket.close()


class StillSensors:
    """A vehicle at rest, while nothing flies yet: the firmware calibrates its gyro and answers only with samples."""

    def __init__(self, stands: int | None) -> None:
        self._done, self._sensors = threading.Event(), Sensors(stands)

    def __enter__(self) -> "StillSensors":
        self._thread = threading.Thread(target=self._feed, daemon=True)
        self._thread.start()
        return self

    def _feed(self) -> None:
        try:
            while not self._done.wait(STILL / 10.0):
                self._sensors.rest(STILL)
        except RunError:  # the firmware has ended, as it does where it is told to keep its settings
            pass

    def __exit__(self, *_: object) -> None:
        self._done.set()
        self._thread.join()
        self._sensors.close()
