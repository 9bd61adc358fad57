"""The bridge:

ArduPilot's software in the loop flies the simulator's vehicle, rope and ball by its JSON interface.

ArduPilot (``sim_vehicle.py -v ArduCopter -f json:127.0.0.1``, or ``arducopter --model
json:127.0.0.1``) sends its servo outputs and waits for a state, by which its clock goes; so the two
are in lock step. The runner speaks MAVLink to it by itself; the release is read from the
mechanism's output. A frame that comes twice is answered twice and flown once; one with a smaller
number says that ArduPilot was started again.

Convention: forward, right, down in the body; north, east, down in the world: our x, -y, -z in both.

Source: ardupilot, libraries/SITL/examples/JSON/readme.md, libraries/SITL/SIM_JSON.h
(servo_packet_16, servo_packet_32)."""

import json
import select
import struct
from typing import Any

import numpy as np
from numpy import ndarray

from hil.links.backends.ardupilot import ArduPilotParams
from hil.links.device import Device, UdpPort
from hil.links.facts import values
from hil.rehearsal.bridges.betaflight_bridge import MotorPlant
from hil.rehearsal.fake import Bridge

FACTS = values("ardupilot")
SERVOS = FACTS["json_port"]  # UDP port on which ArduPilot finds the simulation
# magic, frames a second that it would like, number of the frame; outputs [us] follow
HEAD = struct.Struct("<HHI")
# outputs of a packet by its magic
MAGIC = {FACTS[f"json_magic_{size}"]: FACTS[f"json_outputs_{size}"] for size in ("16", "32")}
OURS = FACTS["motor_order"]

LOW = 1000.0  # MOT_PWM_MIN [us]
HIGH = 2000.0  # MOT_PWM_MAX [us]
ARRIVED = 50.0  # tolerance within which an output has reached its target [us]
# for the next frame of an ArduPilot that was heard [s]; then the plant goes on without it
PATIENCE = 1.0

FLIP = np.array([1.0, -1.0, -1.0])


def outputs(packet: bytes) -> tuple[int, ndarray] | None:
    """Return the number of a frame and its servo outputs [us], shape (16,) or (32,); None for an
    invalid packet.
    """
    if len(packet) < HEAD.size:
        return None
    magic, _, number = HEAD.unpack_from(packet)
    count = MAGIC.get(magic, 0)
    if not count or len(packet) != HEAD.size + 2 * count:
        return None
    return number, np.frombuffer(packet, "<u2", count, HEAD.size).astype(float)


def state_line(time: float, plant: MotorPlant) -> bytes:
    """The state of a vehicle as ArduPilot takes it, a line of JSON between two line feeds."""
    vehicle = plant.state
    x, y, z, w = plant.quat_wb.tolist()
    state = {
        "timestamp": time,
        "imu": {
            "gyro": (FLIP * plant.rate_b).tolist(),
            "accel_body": (FLIP * plant.force_b).tolist(),
        },
        "position": (FLIP * vehicle["pos_w"]).tolist(),
        "velocity": (FLIP * vehicle["vel_w"]).tolist(),
        "quaternion": [w, x, -y, -z],
        "battery": {"voltage": plant.voltage, "current": 0.0},
    }
    return b"\n" + json.dumps(state).encode() + b"\n"


class ArduPilotSitl(Bridge):
    """See the head of this module; ``frames`` were flown, ``repeated`` came again, ``restarts`` of
    ArduPilot.
    """

    unknown = (*Bridge.unknown, "armed")
    plant: MotorPlant
    params: ArduPilotParams

    def connect(self, autopilot: None) -> None:
        """Listen for ArduPilot; raises `LinkError` where the port is taken."""
        self._number = -1
        self.motors = np.zeros(4)
        self.frames = 0
        self.repeated = 0
        self.restarts = 0
        self.port = UdpPort(Device("udp", "127.0.0.1", SERVOS))

    def fly(self) -> None:
        """Fly a period with the next frame's outputs, and answer with the state after it;
        without a frame, fly with the last outputs.
        """
        frame = self._frame()
        self.paced = frame is not None
        if frame is None:
            super().fly()
            return
        number, servos = frame
        if number == self._number:
            self.repeated += 1
        else:
            self.restarts += number < self._number
            self._number = number
            self.frames += 1
            self.motors = np.clip((servos[OURS] - LOW) / (HIGH - LOW), 0.0, 1.0)
            index = self.params.servo_output - 1
            opens = self.params.servo_open_us
            self.output(
                0 <= index < len(servos) and abs(servos[index] - opens) <= ARRIVED, self.plant.time
            )
            super().fly()
        self.port.write(state_line(self.plant.time, self.plant), self.port.sender)

    def _frame(self) -> tuple[int, ndarray] | None:
        while select.select([self.port], [], [], PATIENCE if self.paced else 0.0)[0]:
            frame = outputs(self.port.read() or b"")
            if frame is not None:
                return frame
        return None

    def compute_command(self) -> ndarray:
        return self.motors

    def report(self) -> dict[str, Any]:
        counts = {
            "held": self.plant.held,
            "touchdown": self.plant.touchdown,
            "frames": self.frames,
            "repeated": self.repeated,
            "restarts": self.restarts,
        }
        return super().report() | counts

    def close(self) -> None:
        super().close()
        self.port.close()
