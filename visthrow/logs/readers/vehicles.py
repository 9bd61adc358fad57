"""What vehicle an autopilot's log is of, and which of its outputs drives which rotor.

Source: MAVLink, enum MAV_TYPE; PX4, airframes reference (SYS_AUTOSTART) and CA_AIRFRAME,
CA_ROTOR_COUNT, CA_ROTORn_PX, _PY (forward, right); ArduPilot, FRAME_CLASS, FRAME_TYPE
(AP_MotorsMatrix) and SERVOn_FUNCTION."""

from collections.abc import Mapping
from dataclasses import dataclass

from visthrow.logs.readers.messages import Messages

QUADROTOR = "quadrotor"
ROTORS = {3: "tricopter", 4: QUADROTOR, 6: "hexarotor", 8: "octorotor", 12: "dodecarotor"}
MAV_TYPES = {
    1: "plane",
    2: QUADROTOR,
    3: "coaxial helicopter",
    4: "helicopter",
    7: "airship",
    10: "rover",
    11: "boat",
    12: "submarine",
    13: "hexarotor",
    14: "octorotor",
    15: "tricopter",
    29: "dodecarotor",
} | dict.fromkeys(range(19, 26), "VTOL")
PX4_AIRFRAMES = {1: "plane", 2: "VTOL", 3: "VTOL", 4: "VTOL", 5: "rover", 6: "rover"} | {
    10: "helicopter",
    11: "helicopter",
}
PX4_AUTOSTART = (
    (2000, 4000, "plane"),
    (4000, 6000, QUADROTOR),
    (6000, 8000, "hexarotor"),
    (8000, 10000, "octorotor"),
    (11000, 12000, "hexarotor"),
    (12000, 13000, "octorotor"),
    (13000, 14000, "VTOL"),
    (14000, 15000, "tricopter"),
    (50000, 60000, "rover"),
    (60000, 70000, "submarine"),
)
ARDUPILOT_CLASSES = {1: QUADROTOR, 2: "hexarotor", 3: "octorotor", 4: "octorotor", 5: "hexarotor"}
ARDUPILOT_CLASSES |= {6: "helicopter", 7: "tricopter", 8: "coaxial helicopter", 12: "dodecarotor"}
ARDUPILOT_VEHICLES = {"ArduPlane": "plane", "Rover": "rover", "ArduRover": "rover"}
ARDUPILOT_VEHICLES |= {"ArduSub": "submarine", "Blimp": "airship"}
ARDUPILOT_X = {1: (2, 0, 1, 3), 12: (3, 1, 2, 0), 13: (1, 0, 2, 3), 14: (3, 0, 2, 1)}
"""FRAME_TYPE of a quadrotor X (ArduPilot's, Betaflight's, DJI's, clockwise) -> its motors."""
ARDUPILOT_MOTOR1 = 33  # SERVOn_FUNCTION of the first motor

X = (2, 0, 1, 3)
"""Motors of PX4's and ArduPilot's quadrotor X: front left, front right, rear left, rear right."""


@dataclass(frozen=True)
class Vehicle:
    """The vehicle of a log, as far as the log names it."""

    kind: str = ""  # "": the log does not say
    # motors, from 0, that are front left, front right, rear left, rear right; () where it has
    # other ones than those four
    motors: tuple[int, ...] = X
    outputs: tuple[int, ...] = X  # their outputs, from 0

    @property
    def rotors_alone(self) -> bool:
        """Whether rotors on fixed arms carry it, or the log does not say."""
        return self.kind in ("", "tricopter") or "rotor" in self.kind


def vehicle_of(log: Messages) -> Vehicle:
    """Say which vehicle a log is of."""
    reader = {"ulog": _of_px4, "dataflash": _of_ardupilot}.get(log.kind, _of_heartbeat)
    return reader(log)


def _of_px4(log: Messages) -> Vehicle:
    parameters = log.parameters
    status = log.first("vehicle_status") or {}
    if "is_vtol" in status and max(status["is_vtol"], default=0) > 0:
        return Vehicle("VTOL", (), ())
    kind = PX4_AIRFRAMES.get(int(parameters.get("CA_AIRFRAME", 0)), "")
    kind = kind or MAV_TYPES.get(int(parameters.get("MAV_TYPE", 0)), "")
    count = int(parameters.get("CA_ROTOR_COUNT", 0))
    if count and kind in ("", QUADROTOR):
        kind = ROTORS.get(count, f"vehicle of {count} rotors")
    number = int(parameters.get("SYS_AUTOSTART", 0))
    for first, last, name in PX4_AUTOSTART:
        kind = kind or (name if first <= number < last else "")
    if kind not in ("", QUADROTOR):
        return Vehicle(kind, (), ())
    motors = _by_place(parameters) if kind and "CA_ROTOR0_PX" in parameters else X
    if (kind and not motors) or 5000 <= number < 6000:
        return Vehicle(f"{QUADROTOR} that is no X", (), ())
    return Vehicle(kind, motors, motors)


def _by_place(parameters: Mapping[str, float]) -> tuple[int, ...]:
    """Motors by where they sit; () where each quarter has not one."""
    corners: dict[tuple[bool, bool], int] = {}
    for i in range(4):
        forward, right = (parameters.get(f"CA_ROTOR{i}_P{axis}", 0.0) for axis in "XY")
        if abs(forward) > 0.2 * abs(right) and abs(right) > 0.2 * abs(forward):
            corners[forward > 0.0, right > 0.0] = i
    places = [(True, False), (True, True), (False, False), (False, True)]
    return tuple(corners[place] for place in places) if len(corners) == 4 else ()


def _of_ardupilot(log: Messages) -> Vehicle:
    parameters = log.parameters
    words = str(log.meta.get("firmware", "")).split()
    kind = ARDUPILOT_VEHICLES.get(words[0] if words else "", "")
    if kind == "plane" and parameters.get("Q_ENABLE", 0.0) > 0.0:
        kind = "VTOL"
    kind = kind or ARDUPILOT_CLASSES.get(int(parameters.get("FRAME_CLASS", 0)), "")
    if kind not in ("", QUADROTOR):
        return Vehicle(kind, (), ())
    motors = ARDUPILOT_X.get(int(parameters.get("FRAME_TYPE", 1)), ())
    if not motors:
        return Vehicle(f"{QUADROTOR} that is no X", (), ())
    functions = {int(parameters.get(f"SERVO{n}_FUNCTION", 0)): n - 1 for n in range(32, 0, -1)}
    outputs = tuple(functions.get(ARDUPILOT_MOTOR1 + motor, motor) for motor in motors)
    return Vehicle(kind, motors, outputs)


def _of_heartbeat(log: Messages) -> Vehicle:
    beat = log.first("HEARTBEAT") or {}
    kinds = {MAV_TYPES[int(t)] for t in beat.get("type", ()) if int(t) in MAV_TYPES}
    if len(kinds) != 1 or QUADROTOR in kinds:
        return Vehicle(QUADROTOR if kinds else "")
    return Vehicle(kinds.pop(), (), ())
