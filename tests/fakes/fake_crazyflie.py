"""A Crazyflie by its firmware's source, on a CRTP port; the poses come from the motion capture's
bridge beside it.

Written from the source alone, not from the back-end: `hil.links.facts`, crazyflie, has file and
line of each behaviour. Packets are decoded (crtp_commander_generic.c), kept
by priority (commander.c), cut by the supervisor's states (supervisor_state_machine.c), and flown as
the PID controller takes them (controller_pid.c): roll and pitch as rates, yaw as a rate that moves
the yaw that is held. What follows the rates is the vehicle of the training. A set-point
of a place is held by the fakes' own controller.

Left out: what the back-end never sends (legacy set-points, angles, trajectories), DSHOT's check of
the rotors, and the integral of roll and pitch angles."""

import math
import struct
from dataclasses import dataclass
from typing import Any

import numpy as np

from hil.links.device import Device
from hil.links.facts import values
from tests.fakes.ports import AnsweringPort, PortFake
from visthrow.common.rotations import rotate_back, tilt_and_heading
from visthrow.onboard.hover import GRAVITY

FACTS = values("crazyflie")
HOOK = "hook.open"  # parameter of the app that moves the mechanism
DEFAULTS = {"flightmode.stabModeRoll": 1, "flightmode.stabModePitch": 1, "stabilizer.controller": 0}
"""Parameters that the firmware starts with, where these are not what they have to be."""

PASSED, READY, FLYING, LEVEL, LANDED, LOCKED, CRASHED = (
    "pre-flight checks passed",
    "ready to fly",
    "flying",
    "warning, level out",
    "landed",
    "locked",
    "crashed",
)
MAY_FLY = (READY, FLYING, LEVEL, LANDED)  # states in which the motors may turn

GYRO_NOISE = 0.1  # of a reported body rate [deg/s]
GYRO = tuple(f"gyro.{axis}" for axis in FACTS["log_gyro"])
VARIABLES = (*(f"motor.{letter}" for letter in "abcdefghijk"), *GYRO, "pm.vbat")
"""Variables of its logging, in the order of their numbers."""


@dataclass(frozen=True)
class SetPoint:
    """What the commander holds: rates in degrees a second, as its packets have them."""

    time: float = -math.inf  # when it came [s]
    roll: float = 0.0
    pitch: float = 0.0
    yaw: float = 0.0
    thrust: float = 0.0  # of 65535
    place_w: tuple[float, ...] | None = None  # [m]; None: none is held


class FakeCrazyflie(PortFake):
    """See the head of this module.

    Attributes:
        placed: external poses that came, position [m] and attitude xyzw. supervisor: its state.
        protocol: version that it reports. priority: of the set-point that is flown.
        hook_opens: value of the mechanism's parameter that opens it.
    """

    @staticmethod
    def open_port(number: int) -> AnsweringPort:
        return AnsweringPort(Device("udp", "127.0.0.1", number))

    def __init__(self, *args: Any, **kwargs: Any) -> None:
        super().__init__(*args, **kwargs)
        self.armed = False
        # a change of the yaw rate comes as a pulse, which moves the yaw that is held
        self.witness.limits = (*self.witness.limits[:3], math.inf)
        needed = {name: value for name, value in FACTS.items() if "." in name}
        self.parameters: dict[str, float] = {
            **needed,
            **DEFAULTS,
            HOOK: 0,
            **self.options.parameters,
        }
        self.placed: list[tuple[tuple[float, ...], tuple[float, ...]]] = []
        self.protocol, self.priority, self.hook_opens = FACTS["protocol_state"], 0, 1
        self.supervisor = PASSED
        self.held = SetPoint()  # by the commander
        self._begun = False  # whether it was released from the hand
        self._turned = -math.inf  # of the supervisor [s]
        self._since = self._thrust_at = 0.0  # of the supervisor's state, of the last thrust [s]
        self._tilted: float | None = None
        self._velocity = np.zeros(3)
        self._force = np.array([0.0, 0.0, 1.0])  # specific force, body frame, of one g
        self._yaw_held, self._yaw_sum = 0.0, 0.0  # [rad], [rad s]
        # numbers of the variables of each block, and its period and next time once started [s]
        self._blocks: dict[int, list[int]] = {}
        self._started: dict[int, list[float]] = {}
        self._rng = np.random.default_rng(0)

    def came(self, data: bytes) -> None:
        if self.silent or not data:
            return
        port, channel = data[0] >> FACTS["header_shift"], data[0] & 3
        places = {
            (FACTS["port_generic"], FACTS["channel_set_point"]): self._generic,
            (FACTS["port_localization"], FACTS["channel_pose"]): self._pose,
            (FACTS["port_supervisor"], FACTS["channel_info"]): self._tell_state,
            (FACTS["port_supervisor"], FACTS["channel_command"]): self._command,
            (FACTS["port_platform"], FACTS["channel_version"]): self._tell_version,
            (FACTS["port_param"], FACTS["channel_by_name"]): self._set_parameter,
            (FACTS["port_log"], FACTS["log_contents"]): self._tell_variable,
            (FACTS["port_log"], FACTS["log_control"]): self._log,
        }
        take = places.get((port, channel))
        if take is not None and len(data) > 1:
            take(data[1:])

    def _answer(self, port: str, channel: str, data: bytes) -> None:
        header = bytes([FACTS[port] << FACTS["header_shift"] | FACTS[channel]])
        self.later(self.options.answer_delay, lambda: self.port.write(header + data))

    def _generic(self, data: bytes) -> None:
        """Take a set-point of body rates or of a place."""
        kind, data = data[0], data[1:]
        if kind == FACTS["manual"]:
            roll, pitch, yaw, thrust, rate = struct.unpack("<3fHb", data)
            assert rate == FACTS["manual_rate"], "angles are never sent"
            self._commanded(SetPoint(self.plant.time, roll, pitch, yaw, thrust))
        elif kind == FACTS["position"]:
            *place, yaw = struct.unpack_from("<4f", data)
            self._commanded(SetPoint(self.plant.time, yaw=yaw, place_w=tuple(place)))

    def _commanded(self, set_point: SetPoint) -> None:
        """Hand a set-point to the commander, which drops it where another one has priority."""
        taken = FACTS["priority_crtp"] >= self.priority
        if taken:
            self.held, self.priority = set_point, FACTS["priority_crtp"]
        turns = (
            set_point.roll,
            FACTS["manual_pitch_sign"] * set_point.pitch,
            set_point.yaw,
        )
        thrust = 0.0
        if set_point.thrust > 0.0:
            thrust = self.thrust_map.thrust(set_point.thrust / FACTS["manual_thrust"])
        flies = taken and set_point.place_w is None and self.supervisor in MAY_FLY
        self.set_point((thrust, *map(math.radians, turns)), flies)

    def receiver_speaks(self) -> None:
        """Let a set-point of an external receiver come, without thrust."""
        self.held, self.priority = SetPoint(self.plant.time), FACTS["priority_receiver"]
        self.forget()

    def _pose(self, data: bytes) -> None:
        if data[0] == FACTS["external_pose"] and len(data) >= struct.calcsize("<B7f"):
            numbers = struct.unpack_from("<7f", data, 1)
            self.placed.append((numbers[:3], numbers[3:]))

    def _tell_state(self, data: bytes) -> None:
        if data[0] != FACTS["ask_state"]:
            return
        state = {
            "can_arm": self.supervisor == PASSED,
            "armed": self.armed,
            "can_fly": self.supervisor in MAY_FLY,
            "flying": self.supervisor in (FLYING, LEVEL),
            "locked": self.supervisor == LOCKED,
            "crashed": self.supervisor == CRASHED,
        }
        bits = sum(FACTS[name] for name, on in state.items() if on)
        payload = bytes([FACTS["ask_state"] | FACTS["answer"]]) + struct.pack("<H", bits)
        self._answer("port_supervisor", "channel_info", payload)

    def _tell_version(self, data: bytes) -> None:
        if data[0] == FACTS["ask_protocol"]:
            payload = bytes([FACTS["ask_protocol"]]) + struct.pack("<i", self.protocol)
            self._answer("port_platform", "channel_version", payload)

    def _command(self, data: bytes) -> None:
        if data[0] != FACTS["arm"] or len(data) < 2:
            return
        arm = bool(data[1])
        if arm and not (self.supervisor == PASSED and self.options.arming):
            return
        if arm != self.armed:
            self.armed = arm
            self.note_event("armed" if arm else "disarmed")

    def _set_parameter(self, data: bytes) -> None:
        if data[0] != FACTS["set_by_name"] or data.count(b"\0") < 2:
            return
        group, name, rest = data[1:].split(b"\0", 2)
        known = f"{group.decode('ascii', 'replace')}.{name.decode('ascii', 'replace')}"
        if known not in self.parameters:
            error = FACTS["no_entry"]
        elif len(rest) < 2 or rest[0] != FACTS["type_uint8"]:
            error = FACTS["wrong_type"]
        else:
            error, self.parameters[known] = 0, rest[1]
        if known == HOOK and error == 0 and rest[1] == self.hook_opens:
            self.note_release()
            if self.options.answer == "silent":
                return
            self.witness.note_answer()
            error = FACTS["no_entry"] if self.options.answer == "denied" else error
            self.open_mechanism()
        payload = data[: len(data) - len(rest)] + bytes([error])
        self._answer("port_param", "channel_by_name", payload)

    def _tell_variable(self, data: bytes) -> None:
        if data[0] == FACTS["log_info"]:
            payload = struct.pack("<BHI", FACTS["log_info"], len(VARIABLES), 0)
        else:
            _, number = struct.unpack_from("<BH", data)
            name = VARIABLES[number].replace(".", "\0").encode() + b"\0"
            payload = struct.pack("<BHB", FACTS["log_item"], number, FACTS["log_float"]) + name
        self._answer("port_log", "log_contents", payload)

    def _log(self, data: bytes) -> None:
        """Create or start a block of variables."""
        command, block, error = data[0], data[1], 0
        if command == FACTS["log_create"]:
            error = FACTS["log_exists"] if block in self._blocks else 0
            numbers = [number for _, number in struct.iter_unpack("<BH", data[2:])]
            self._blocks.setdefault(block, numbers)
        elif command == FACTS["log_start"] and block in self._blocks:
            period = 1e-3 * struct.unpack_from("<H", data, 2)[0]
            self._started[block] = [period, self.plant.time]
        else:
            error = FACTS["no_entry"]
        self._answer("port_log", "log_control", bytes([command, block, error]))

    def speak(self) -> None:
        """Send the blocks that are due."""
        noise = GYRO_NOISE * self._rng.standard_normal(len(GYRO))
        rates = dict(zip(GYRO, np.degrees(self.plant.state["rate_b"]) + noise))
        for block, due in self._started.items():
            if self.plant.time >= due[1] - 1e-9 and not self.silent:
                due[1] += due[0]
                named = [VARIABLES[number] for number in self._blocks[block]]
                numbers = [rates.get(name, 0.0) for name in named]
                stamp = bytes([block]) + int(1e3 * self.plant.time).to_bytes(3, "little")
                self._answer("port_log", "log_data", stamp + struct.pack("<3f", *numbers))

    def _go(self, state: str) -> None:
        """Enter a state of the supervisor; those that may not fly disarm."""
        if state == self.supervisor:
            return
        self.supervisor, self._since = state, self.plant.time
        self.note_event(state)
        if state not in MAY_FLY:
            self.armed = False

    def _supervise(self) -> None:
        """Take a turn of the supervisor, where one is due."""
        time = self.plant.time
        if time - self._turned < 1.0 / FACTS["supervisor_rate"] - 1e-9:
            return
        self._turned = time
        age, in_state = time - self.held.time, time - self._since
        flying = time - self._thrust_at < FACTS["flying_hold"] and self._begun
        tumbled = self._tumbled()
        if self.parameters["stabilizer.stop"] and self.supervisor != LOCKED:
            self._go(LOCKED)
        elif self.supervisor == PASSED and self.armed and not tumbled:
            self._go(READY)
        elif self.supervisor == READY:
            if tumbled or in_state > FACTS["preflight"] or not self.armed:
                self._go(PASSED)
            elif flying:
                self._go(FLYING)
        elif self.supervisor in (FLYING, LEVEL) and age > FACTS["stops_after"]:
            self._go(LOCKED)
        elif self.supervisor in (FLYING, LEVEL) and tumbled:
            self._go(CRASHED if self.supervisor == FLYING else LOCKED)
        elif self.supervisor == FLYING and not self.armed:
            self._go(PASSED)
        elif self.supervisor in (FLYING, LEVEL) and (self.supervisor == LEVEL) != (
            age > FACTS["levels_after"]
        ):
            self._go(LEVEL if self.supervisor == FLYING else FLYING)
        elif self.supervisor == FLYING and not flying:
            self._go(LANDED)
        elif self.supervisor == LANDED:
            if in_state > FACTS["landing"] or not self.armed:
                self._go(PASSED)
            elif flying:
                self._go(FLYING)

    def _tumbled(self) -> bool:
        """Return whether it was tilted, or on its head, for too long."""
        time, up = self.plant.time, self._force[2]
        free = bool(np.all(np.abs(self._force) < FACTS["free_fall"]))
        if free or up >= FACTS["tilt_share"]:
            self._tilted = None
            return False
        self._tilted = time if self._tilted is None else self._tilted
        over = up < FACTS["over_share"] and time - self._tilted > FACTS["over_time"]
        return over or time - self._tilted > FACTS["tilt_time"]

    def take(self) -> None:
        """Stop all: there is no pilot beside the runner, but its emergency stop."""
        self.parameters["stabilizer.stop"] = 1

    def compute_command(self) -> np.ndarray:
        """Return the command of this period; before the takeover a person holds the vehicle."""
        self._sense()
        self._supervise()
        place_w, target = self.held.place_w, self._target
        may = self.supervisor in MAY_FLY and not self.parameters["motorPowerSet.enable"]
        thrust = 0.0 if target is None or not may else target[0]
        if may and place_w is not None and self._begun:
            thrust = 1.0
        self._begun |= thrust > 0.0
        if not self._begun:
            return self.hold(self._place)
        if thrust == 0.0:
            self._yaw_held, self._yaw_sum = self._heading(), 0.0
            return np.zeros(4)
        self._thrust_at = self.plant.time
        if place_w is not None:
            return self.hold(np.array(place_w))
        return np.array([thrust, *self._rates(target)])

    def _sense(self) -> None:
        """Take the accelerometer's specific force by the change of velocity."""
        now = self.plant.state
        velocity = now["vel_w"].astype(float)
        pull = (velocity - self._velocity) / self.plant.period / GRAVITY + np.array([0.0, 0.0, 1.0])
        self._velocity = velocity
        if self._begun:
            self._force = rotate_back(now["quat_wb"][None].astype(float), pull[None])[0]

    def _heading(self) -> float:
        return tilt_and_heading(tuple(self.plant.state["quat_wb"].tolist()))[1]

    def _rates(self, target: np.ndarray) -> np.ndarray:
        """Return the body rates that the PID controller commands [rad/s], forward, left, up."""
        rates = target[1:].copy()
        if self.supervisor == LEVEL:
            x, y, z, w = map(float, self.plant.state["quat_wb"])
            roll = math.atan2(2.0 * (w * x + y * z), 1.0 - 2.0 * (x * x + y * y))
            pitch = math.asin(min(max(2.0 * (w * y - z * x), -1.0), 1.0))
            rates = FACTS["level_p"] * np.array([-roll, -pitch, 0.0])
        dt, turned = self.plant.period, float(self.plant.state["rate_b"][2])
        self._yaw_held += rates[2] * dt
        error = math.remainder(self._yaw_held - self._heading(), 2.0 * math.pi)
        self._yaw_sum += error * dt
        rates[2] = FACTS["yaw_p"] * error + FACTS["yaw_i"] * self._yaw_sum - FACTS["yaw_d"] * turned
        return rates

    def report(self) -> dict[str, Any]:
        return {
            **super().report(),
            "poses": len(self.placed),
            "supervisor": self.supervisor,
            "parameters": self.parameters,
        }
