"""Betaflight's packets between firmware and simulator: samples of the sensors in, motor outputs
out.

Convention: the firmware wants rates forward, right, down; the negative of the specific force
forward, left, up; the attitude w, x, y, z of forward, left, up in north, west, up. It answers every
packet of samples with one of motors, in the order front right, rear left, front left, rear right.

A stamp says up to when the firmware may run. The packets of a datagram are taken one after the
other, and answered together (``lockstep.c``).

Source: betaflight 4.6, src/platform/SIMULATOR/sitl.c (updateState, micros64,
pwmCompleteMotorUpdate) and target/SITL/target.h."""

import os
import select
import socket
import struct
import threading
from collections.abc import Iterator, Sequence
from contextlib import contextmanager, suppress

import numpy as np
from numpy import ndarray

from hil.errors import RunError
from hil.links.facts import values

FACTS = values("betaflight")
GRAVITY = FACTS["gravity"]  # of the firmware's accelerometer [m/s^2]
SENSORS = FACTS["sensor_port"]  # UDP port that samples go to
# stamp, rates (3), acceleration (3), attitude (4), velocity (3), position (3), pressure
FDM = struct.Struct("<18d")
TIME = 8  # bytes of the firmware's time before its answers
MOTORS = 4  # in an answer
LARGEST_ANSWER = 4096  # bytes of all
OURS = FACTS["motor_order"]
SEA_LEVEL = 101325.0  # [Pa]

STEP = 0.002
CALIBRATION = 3.0
"""Between two packets at rest, and the time that the firmware's gyro takes to be calibrated and its
receiver to begin [s].
"""

# for the firmware to come to a stamp [s], on the wall's clock: a tenth of a millisecond is usual
PATIENCE = 10.0


def sample(
    stamp: float, rate_b: Sequence[float], force_b: Sequence[float], quat_wb: Sequence[float]
) -> bytes:
    """Packet of body rates [rad/s], specific force [m/s^2], body frame, and attitude xyzw."""
    x, y, z, w = quat_wb
    x_force, y_force, z_force = force_b
    return FDM.pack(
        stamp,
        rate_b[0],
        -rate_b[1],
        -rate_b[2],
        -x_force,
        -y_force,
        -z_force,
        w,
        x,
        y,
        z,
        *(0.0, 0.0, 0.0),  # velocity
        *(0.0, 0.0, 0.0),  # position
        SEA_LEVEL,
    )


def read_answer(stands: int, timeout: float) -> bytes:
    """Read what a firmware in lock step writes to its pipe once it stands still; nothing where it
    does not within a time [s].
    """
    return os.read(stands, LARGEST_ANSWER) if select.select([stands], [], [], timeout)[0] else b""


class Sensors:
    """The address of samples, and the firmware's clock."""

    def __init__(self, stands: int):
        """Open a socket; ``stands``: pipe on which the firmware says that it has come
        to a stamp.
        """
        self._socket = socket.socket(socket.AF_INET, socket.SOCK_DGRAM)
        self._socket.connect(("127.0.0.1", SENSORS))
        self._stands = stands
        self._stamp = 0.0
        self._last: tuple[Sequence[float], ...] = (
            (0.0, 0.0, 0.0),
            (0.0, 0.0, GRAVITY),
            (0.0, 0.0, 0.0, 1.0),
        )

    def send(self, rates_b: ndarray, force_b: ndarray, quat_wb: ndarray, period: float) -> ndarray:
        """Send samples, let the firmware run for a period [s] with each, and wait until it has;
        raises `RunError` where it does not run.

        Args:
            rates_b: [rad/s], shape (N, 3), body frame; N at most 16.
            force_b: specific force [m/s^2], shape (3,), body frame. quat_wb: attitude xyzw.

        Returns:
            Motor outputs that came, 0 to 1, shape (M, 4), in our order; M is N, or less where the
            firmware is not ready.
        """
        force = force_b.tolist()
        quat = quat_wb.tolist()
        packets = []
        for rate in rates_b.tolist():
            self._stamp += period
            self._last = (rate, force, quat)
            packets.append(sample(self._stamp, *self._last))
        return self._run(b"".join(packets))

    def _run(self, packets: bytes) -> ndarray:
        self._socket.send(packets)
        answer = read_answer(self._stands, PATIENCE)
        if not answer:
            raise RunError(
                f"the firmware did not reach the time {self._stamp:.3f} s of its samples within"
                f" {PATIENCE:g} s"
            )
        return np.frombuffer(answer, np.float32, offset=TIME).reshape(-1, MOTORS)[:, OURS]

    def rest(self, period: float) -> None:
        """Let the firmware run for a period [s] with a vehicle at rest in its last attitude."""
        self._stamp += period
        self._run(sample(self._stamp, *self._last))

    def start(self) -> None:
        """Let the firmware calibrate its sensors, the vehicle standing still.

        Raises `RunError`: see `send`.
        """
        for _ in range(round(CALIBRATION / STEP)):
            self.rest(STEP)

    def close(self) -> None:
        """Close the socket."""
        self._socket.close()


@contextmanager
def feed_at_rest(stands: int) -> Iterator[None]:
    """Feed a firmware with a vehicle at rest, while nothing flies yet: it calibrates its gyro and
    answers only with samples.
    """
    done = threading.Event()
    sensors = Sensors(stands)

    def feed() -> None:
        # the firmware ends where it is told to keep its settings
        with suppress(RunError):
            while not done.wait(STEP / 10.0):
                sensors.rest(STEP)

    thread = threading.Thread(target=feed, daemon=True)
    thread.start()
    try:
        yield
    finally:
        done.set()
        thread.join()
        sensors.close()
