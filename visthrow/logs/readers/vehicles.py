"""The kind of vehicle of an autopilot's log, and the output that drives each rotor.

``vehicles.toml`` has the numbers by which autopilots name vehicles.

Source: PX4, CA_ROTOR_COUNT, CA_ROTORn_PX, _PY (forward, right); ArduPilot, SERVOn_FUNCTION."""

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any

from visthrow.common.toml_text import tables_beside
from visthrow.logs.readers.messages import Messages

QUADROTOR = "quadrotor"
TABLES = tables_beside(__file__)
ARDUPILOT_MOTOR1 = 33  # SERVOn_FUNCTION of the first motor

X = (2, 0, 1, 3)
"""Indices of the motors of PX4's and ArduPilot's quadrotor X: front left, front right, rear left,
rear right.
"""


@dataclass(frozen=True)
class Vehicle:
    """The vehicle of a log, as far as the log identifies it."""

    kind: str = ""  # "": unknown
    # indices of the motors front left, front right, rear left, rear right; () if it has other
    # motors than these four
    motors: tuple[int, ...] = X
    outputs: tuple[int, ...] = X  # their outputs, from 0

    @property
    def rotors_alone(self) -> bool:
        """True if rotors on fixed arms carry the vehicle, or its kind is unknown."""
        return self.kind in ("", "tricopter") or "rotor" in self.kind


def vehicle_of(log: Messages) -> Vehicle:
    """Return the vehicle of a log."""
    reader = {"ulog": _read_px4, "dataflash": _read_ardupilot}.get(log.kind, _read_heartbeat)
    return reader(log)


def _name_of(table: str, number: float, default: Any = "") -> Any:
    """Return the entry of a number in a table of ``vehicles.toml``."""
    return TABLES[table].get(str(int(number)), default)


def _read_px4(log: Messages) -> Vehicle:
    parameters = log.parameters
    status = log.first("vehicle_status") or {}
    if max(status.get("is_vtol", ()), default=0) > 0:
        return Vehicle("VTOL", (), ())
    kind = _kind_of_px4(parameters)
    if kind not in ("", QUADROTOR):
        return Vehicle(kind, (), ())
    motors = _order_motors(parameters) if kind and "CA_ROTOR0_PX" in parameters else X
    plus = int(parameters.get("SYS_AUTOSTART", 0)) // 1000 == 5
    if plus or (kind and not motors):
        return Vehicle(f"{QUADROTOR} that is no X", (), ())
    return Vehicle(kind, motors, motors)


def _kind_of_px4(parameters: Mapping[str, float]) -> str:
    kind = _name_of("px4_airframes", parameters.get("CA_AIRFRAME", 0))
    kind = kind or _name_of("mav_types", parameters.get("MAV_TYPE", 0))
    count = int(parameters.get("CA_ROTOR_COUNT", 0))
    if count and kind in ("", QUADROTOR):
        kind = _name_of("rotors", count, f"vehicle of {count} rotors")
    return kind or _name_of("px4_autostart", parameters.get("SYS_AUTOSTART", 0) // 1000)


def _order_motors(parameters: Mapping[str, float]) -> tuple[int, ...]:
    """Return the motors in the order front left, front right, rear left, rear right; () unless
    there is one in each quadrant.
    """
    corners: dict[tuple[bool, bool], int] = {}
    for i in range(4):
        forward, right = (parameters.get(f"CA_ROTOR{i}_P{axis}", 0.0) for axis in "XY")
        if abs(forward) > 0.2 * abs(right) and abs(right) > 0.2 * abs(forward):
            corners[forward > 0.0, right > 0.0] = i
    places = [(True, False), (True, True), (False, False), (False, True)]
    return tuple(corners[place] for place in places) if len(corners) == 4 else ()


def _read_ardupilot(log: Messages) -> Vehicle:
    parameters = log.parameters
    words = str(log.meta.get("firmware", "")).split()
    kind = TABLES["ardupilot_firmwares"].get(words[0] if words else "", "")
    if kind == "plane" and parameters.get("Q_ENABLE", 0.0) > 0.0:
        kind = "VTOL"
    kind = kind or _name_of("ardupilot_classes", parameters.get("FRAME_CLASS", 0))
    if kind not in ("", QUADROTOR):
        return Vehicle(kind, (), ())
    motors = tuple(_name_of("ardupilot_x", parameters.get("FRAME_TYPE", 1), ()))
    if not motors:
        return Vehicle(f"{QUADROTOR} that is no X", (), ())
    functions = {int(parameters.get(f"SERVO{n}_FUNCTION", 0)): n - 1 for n in range(32, 0, -1)}
    outputs = tuple(functions.get(ARDUPILOT_MOTOR1 + motor, motor) for motor in motors)
    return Vehicle(kind, motors, outputs)


def _read_heartbeat(log: Messages) -> Vehicle:
    beat = log.first("HEARTBEAT") or {}
    kinds = {_name_of("mav_types", number) for number in beat.get("type", ())} - {""}
    if len(kinds) != 1 or QUADROTOR in kinds:
        return Vehicle(QUADROTOR if kinds else "")
    return Vehicle(kinds.pop(), (), ())
