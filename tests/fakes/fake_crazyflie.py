"""A fake Crazyflie on a CRTP port; the poses come from the motion capture's bridge beside it.

Set-points are angles until both modes were set to rates, and fly nothing until one without thrust
unlocked it and it was armed. Pitch is nose down. Silence of its commander levels it after 0.5 s and
stops its motors after 2 s. An unknown parameter is answered with an error."""

import math
from typing import Any

import numpy as np

from hil.links import crtp
from hil.links.backends.crazyflie import FULL, MODES
from hil.links.device import Device
from hil.rehearsal.fake import PortFake
from tests.fakes.ports import AnsweringPort

LEVELS_AFTER, STOPS_AFTER = (
    0.5,
    2.0,
)  # silence of set-points [s]: COMMANDER_WDT_TIMEOUT_STABILIZE and _SHUTDOWN
LEAST = 1000  # Thrust below this is none (MIN_THRUST)

ENOENT = 2


class FakeCrazyflie(PortFake):
    """See the head of this module; ``placed`` holds external poses that came, position [m] and
    attitude xyzw.
    """

    @staticmethod
    def open_port(number: int) -> AnsweringPort:
        return AnsweringPort(Device("udp", "127.0.0.1", number))

    def __init__(self, *args: Any, **kwargs: Any) -> None:
        super().__init__(*args, **kwargs)
        self.armed = False
        self.parameters: dict[str, float] = {
            **dict.fromkeys(MODES, 1),
            "hook.open": 0,
            **self.options.parameters,
        }
        self.placed: list[tuple[tuple[float, ...], tuple[float, ...]]] = []
        self._locked, self._heard, self._stopped = True, -math.inf, False

    def came(self, data: bytes) -> None:
        packet = crtp.unpack(data)
        if packet is not None and not self.silent:
            self._hear(packet)

    def _hear(self, packet: crtp.Packet) -> None:
        place, data = (packet.port, packet.channel), packet.data
        if place == (crtp.COMMANDER, 0) and len(data) == crtp.SET_POINT.size:
            self._set_point(*crtp.SET_POINT.unpack(data))
        elif (
            place == (crtp.LOCALIZATION, crtp.GENERIC)
            and len(data) == crtp.POSE.size
            and data[0] == crtp.EXTERNAL_POSE
        ):
            values = crtp.POSE.unpack(data)[1:]
            self.placed.append((values[:3], values[3:]))
        elif place == (crtp.SUPERVISOR, crtp.INFO) and data[:1] == bytes([crtp.STATE]):
            flying, stopped = bool(self.last_thrust > 0.0), self._stopped
            state = (
                crtp.CAN_FLY
                | crtp.ARMED * self.armed
                | crtp.FLYING * flying
                | crtp.LOCKED * stopped
            )
            self._answer(
                crtp.SUPERVISOR,
                crtp.INFO,
                bytes([crtp.STATE | crtp.ANSWER]) + state.to_bytes(4, "little"),
            )
        elif (
            place == (crtp.SUPERVISOR, crtp.COMMAND)
            and data[:1] == bytes([crtp.ARM])
            and len(data) == 2
        ):
            self.armed = bool(data[1]) and self.options.arming and not self._stopped
            self.happened("armed" if self.armed else "disarmed")
        elif place == (crtp.PARAM, crtp.BY_NAME) and data[:1] == bytes([crtp.SET_BY_NAME]):
            self._set_parameter(data)

    def _answer(self, port: int, channel: int, data: bytes) -> None:
        self.later(
            self.options.answer_delay,
            lambda: self.port.write(crtp.Packet(port, channel, data).pack()),
        )

    def _set_parameter(self, data: bytes) -> None:
        group, name, rest = data[1:].split(b"\0", 2)
        known = f"{group.decode()}.{name.decode()}"
        error = 0 if known in self.parameters and len(rest) == 2 else ENOENT
        if not error:
            self.parameters[known] = rest[1]
        if known == "hook.open" and rest[1:] == b"\1":
            self.note_release()
            if self.options.answer == "silent":
                return
            self.witness.answered()
            error = ENOENT if self.options.answer == "denied" else error
            self.open_mechanism()
        self._answer(crtp.PARAM, crtp.BY_NAME, data[: -len(rest)] + bytes([error]))

    def _set_point(self, roll: float, pitch: float, yaw: float, thrust: int) -> None:
        self._heard = self.plant.time
        self._locked &= thrust != 0
        rates = tuple(math.radians(rate) for rate in (roll, -pitch, yaw))
        command = (
            self.thrust_map.thrust(min(thrust, FULL) / FULL) if thrust >= LEAST else 0.0,
            *rates,
        )
        self.set_point(
            command,
            self.armed and not self._locked and not any(self.parameters[mode] for mode in MODES),
        )

    def take(self) -> None:
        """Stop all: there is no pilot beside the runner, but its emergency stop."""
        self.armed, self._stopped = False, True
        self.happened("emergency stop")

    def flown(self) -> np.ndarray:
        """Return the command of this period; before the runner has it somebody holds it in the
        hand.
        """
        quiet = self.plant.time - self._heard
        if self._target is None or not self.followed:
            return self.hold(self._place)
        if quiet > STOPS_AFTER or not self.armed:
            self.happened("motors off")
            return np.zeros(4)
        if quiet > LEVELS_AFTER:
            self.happened("commander: level")
            return np.array([self._target[0], 0.0, 0.0, 0.0])
        return self._target

    def report(self) -> dict[str, Any]:
        return {**super().report(), "poses": len(self.placed), "parameters": self.parameters}
