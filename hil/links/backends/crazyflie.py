"""Crazyflie over CRTP: body rates and thrust as legacy set-points in rate mode, the release as a
parameter, poses to its estimator.

It has no hold of its own that takes over in mid flight here: the runner's hover controller flies
before and after the throw. Silence of 0.5 s levels it, of 2 s stops the motors (its commander's
watchdog). Thrust stays locked until a set-point without thrust came. A set-point means rates only
after ``flightmode.stabModeRoll`` and ``stabModePitch`` were set to 0, which is done, and answered,
before anything is armed.

Source: crazyflie-firmware, crtp_commander_rpyt.c, commander.c (COMMANDER_WDT_TIMEOUT),
supervisor.c, param_logic.c (paramSetByName)."""

import math
from dataclasses import dataclass

from hil.links import crtp
from hil.links.backends.base import ACCEPTED, FOLLOW, PENDING, WAIT, OnPort, Release
from hil.links.backends.thrust import ThrustParams
from hil.links.device import Port, chunks
from hil.poses.pose import VEHICLE
from hil.poses.track import Track
from visthrow.common.errors import ConfigError
from visthrow.config.bounds import Bounded, NotNegative, Positive

FULL = 60000  # most of 65535 that the firmware takes (MAX_THRUST)
MODES = ("flightmode.stabModeRoll", "flightmode.stabModePitch")  # parameters that are 0 for rates

ASK, KEEP_ALIVE, SET_AGAIN = 0.1, 0.02, 0.2
"""Between two questions for its state, two set-points before it is flown, two tries of a parameter
[s].
"""

BLOCKS = {crtp.TUMBLED: "tumbled", crtp.LOCKED: "locked: restart it"}


@dataclass(frozen=True)
class CrazyflieParams(Bounded):
    """The vehicle on the other side."""

    # radio://0/80/2M/E7E7E7E7E7, usb://0, or udpout:127.0.0.1:19850 of its software in the loop
    device: str
    remote: bool  # whether a network device may leave this machine
    thrust: ThrustParams
    release_parameter: (
        str  # of eight bits that opens the mechanism at 1: group.name of an app or a deck
    )
    mechanism_lag: NotNegative  # from the parameter's change to separation [s]
    release_timeout: Positive  # without an answer the release has failed [s]
    silence: Positive  # after which it counts as lost [s]
    external_pose: bool = True  # send the vehicle's poses to its estimator

    def __post_init__(self) -> None:
        super().__post_init__()
        if (
            not all(self.release_parameter.partition(".")[::2])
            or len(crtp.set_parameter(self.release_parameter, 1)) > crtp.MOST
        ):
            raise ConfigError(
                f"crazyflie.release_parameter '{self.release_parameter}'; expected group.name of at"
                " most 25 letters"
            )


class Crazyflie(OnPort):
    """A Crazyflie; ``poses`` counts those that went to its estimator."""

    name, protocol = "crazyflie", "CRTP"

    def __init__(self, port: Port, params: CrazyflieParams) -> None:
        super().__init__(port, params.silence)
        self.params = params
        self.release_record = Release(params.release_timeout)
        self.poses = 0
        self._state = 0
        self._told: dict[str, bool] = dict.fromkeys(MODES, False)  # whether its answer came
        self._asked = self._sent = self._set = -1e9

    def _hint(self) -> str:
        return "it is being armed" if self._taken and not self._raised else ""

    def _known(self) -> tuple[str, str]:
        if not all(self._told.values()):
            return "its set-points are being set to rates", WAIT
        blocked = [text for bit, text in BLOCKS.items() if self._state & bit]
        if blocked:
            return ", ".join(blocked), WAIT
        armed = bool(self._state & crtp.ARMED)
        if armed and self._taken:
            self._raised = True
            return "", FOLLOW
        return ("disarmed" if self._raised else ""), WAIT

    def place(self, body: str, track: Track) -> None:
        """Hand a pose of the vehicle to its estimator, as it was taken; for `Runner.watcher`."""
        pose = track.sample()[0]
        if body == VEHICLE and self.params.external_pose and pose.quat is not None:
            self.poses += self._put(crtp.external_pose(pose.pos, pose.quat))

    def send(self, command: tuple[float, ...], now: float) -> bool:
        thrust, *rates = command
        armed = bool(self._state & crtp.ARMED) and self._taken
        share = self.params.thrust.share(thrust) if armed else 0.0
        x, y, z = (math.degrees(rate) for rate in rates)
        self._sent = now
        return self._put(
            crtp.set_point(round(FULL * share), (x, y, z) if armed else (0.0, 0.0, 0.0))
        )

    def rearm(self) -> None:
        """Forget the last release; the mechanism closes, so that the next payload can
        be hung on.
        """
        super().rearm()
        self._put(crtp.set_parameter(self.params.release_parameter, 0))

    def service(self, now: float) -> None:
        for data in chunks(self._port):
            if (packet := crtp.unpack(data)) is not None:
                self._hear(packet, now)
        if now - self._asked >= ASK:
            self._asked = now
            self._put(crtp.Packet(crtp.SUPERVISOR, crtp.INFO, bytes([crtp.STATE])).pack())
        if now - self._set >= SET_AGAIN:
            self._set = now
            for name, told in self._told.items():
                if not told:
                    self._put(crtp.set_parameter(name, 0))
            ready = self._taken and not self._over and all(self._told.values())
            if ready and not self._state & crtp.ARMED and not self._raised:
                self._put(crtp.arm(True))
        if self.release_record.due(now):
            self._put(crtp.set_parameter(self.params.release_parameter, 1))
        if now - self._sent >= KEEP_ALIVE and not self._raised and not self._over:
            self.send((0.0, 0.0, 0.0, 0.0), now)  # without thrust: unlocks it

    def finish(self, now: float) -> None:
        """Stop the motors."""
        self._over = True
        self._put(crtp.set_point(0, (0.0, 0.0, 0.0)))
        self._put(crtp.arm(False))

    def _hear(self, packet: crtp.Packet, now: float) -> None:
        if (packet.port, packet.channel) == (crtp.SUPERVISOR, crtp.INFO) and packet.data[
            :1
        ] == bytes([crtp.STATE | crtp.ANSWER]):
            self._heard, self._state = now, int.from_bytes(packet.data[1:5], "little")
        elif (packet.port, packet.channel) == (crtp.PARAM, crtp.BY_NAME) and packet.data[
            :1
        ] == bytes([crtp.SET_BY_NAME]):
            known, refused = packet.data[1:-1], packet.data[-1] != 0
            for mode in MODES:
                self._told[mode] |= known == crtp.named(mode) and not refused
            if known == crtp.named(self.params.release_parameter) and self.release_record.state in (
                PENDING,
                ACCEPTED,
            ):
                self.release_record.answer(
                    not refused, "the parameter is not known to the firmware"
                )
