"""Back-end of the Crazyflie over CRTP: body rates and thrust as manual set-points, the release as a
parameter, poses for its estimator.

The runner's hover controller flies before and after the throw. A manual set-point states that it
holds rates, and its thrust is neither locked nor cut; the vehicle follows it as soon as it is
armed. The parameters of ``flightmode`` define the meaning of legacy set-points, which others may
send. These parameters, the controller and the motors' override are set and acknowledged before the
vehicle is armed. Without set-points its supervisor levels the vehicle, and later stops its motors.
Body rates come from its logging. A vehicle that is handed back holds its position by its own
controller, as long as it receives position set-points.

Source: `hil.links.facts`, crazyflie."""

import math
from dataclasses import dataclass

from hil.links import crtp
from hil.links.backends.audit import NO_SUCH_PARAMETER, Audit, Rule, rules_of
from hil.links.backends.base import (
    ACCEPTED,
    FOLLOW,
    PENDING,
    WAIT,
    Command,
    OnPort,
    PortVehicleParams,
    Release,
)
from hil.links.backends.crazyflie_gyro import GyroStream
from hil.links.device import Port, chunks
from hil.links.facts import facts, values
from hil.links.roster import Announce
from hil.poses.body_track import Track
from hil.poses.pose import VEHICLE
from visthrow.common.errors import ConfigError
from visthrow.common.rotations import tilt_and_heading

FACTS = values("crazyflie")
# parameters set before arming
MODES = {name: fact for name, fact in facts("crazyflie").items() if "." in name}

ASK = 0.1  # between two requests for its state [s]
ARM_PERIOD = 0.2  # between two requests to arm [s]
HOLDS = 2.0  # for which a vehicle that is handed back holds its position [s]
DESCENT = 0.3  # at which it descends then [m/s]
SHORTEST = 0.02  # least duration over which a change of the yaw rate is spread: a period [s]

BLOCKS = {
    FACTS["tumbled"]: "tumbled",
    FACTS["locked"]: "locked: restart it",
    FACTS["crashed"]: "crashed: recover or restart it",
    FACTS["deck_fault"]: "a deck reports a fault",
}


@dataclass(frozen=True)
class CrazyflieParams(PortVehicleParams):
    """Settings of a Crazyflie. Its device is radio://0/80/2M/E7E7E7E7E7, usb://0, or
    udpout:127.0.0.1:19850 for its software in the loop.
    """

    # eight-bit parameter that opens the mechanism when it is 1: group.name of an app or a deck
    release_parameter: str
    external_pose: bool = True  # whether the vehicle's poses are sent to its estimator

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
    """The back-end of a Crazyflie; ``poses`` counts the poses sent to its estimator."""

    name = "crazyflie"
    protocol = "CRTP"
    params: CrazyflieParams

    def __init__(self, port: Port, params: CrazyflieParams, tell: Announce):
        """Use CRTP on an open port; ``tell``: called with the table of settings and with refused
        senders.
        """
        super().__init__(port, params, tell)
        self.release_record = Release(params.release_timeout)
        self.poses = 0
        self.audit = Audit(self._rules(), self._ask, None, tell)
        self.gyro = GyroStream(self._put)
        self._state = 0
        self._speaks = False
        self._place: tuple[tuple[float, ...], float] | None = None  # position [m], heading [deg]
        self._returned: tuple[float, tuple[float, ...], float] | None = None  # when, and where
        self._yaw = 0.0, -1e9  # last commanded yaw rate [rad/s], and when [s]
        self._asked = self._armed_at = -1e9

    def _rules(self) -> list[Rule]:
        protocol, release = rules_of(self.name, self.params)
        modes = [Rule(name, fact.means, (fact.value,)) for name, fact in MODES.items()]
        return [protocol, *modes, release]

    def _ask(self, name: str) -> None:
        """Request the protocol's version, or set a parameter; the answer confirms its value."""
        if name == "protocol":
            self._put(crtp.ask_protocol())
        else:
            self._put(crtp.set_parameter(name, FACTS.get(name, 0)))

    def _hint(self) -> str:
        return "it is being armed" if self._taken and not self._raised else ""

    def _judge(self) -> tuple[str, str]:
        if not self.audit.done:
            flies = self._state & FACTS["flying"]
            return "it flies: land it first" if flies else "its settings are being set", WAIT
        blocked = [text for bit, text in BLOCKS.items() if self._state & bit]
        if blocked:
            return ", ".join(blocked), WAIT
        armed = bool(self._state & FACTS["armed"])
        if armed and self._taken:
            self._raised = True
            return "", FOLLOW
        return ("disarmed" if self._raised else ""), WAIT

    def place(self, body: str, track: Track) -> None:
        """Send an accepted pose of the vehicle to its estimator; called as
        `StateEstimator.watcher`.
        """
        pose = track.sample()[0]
        if body == VEHICLE and self.params.external_pose and pose.quat is not None:
            self._place = pose.pos, math.degrees(tilt_and_heading(pose.quat)[1])
            self.poses += self._put(crtp.external_pose(pose.pos, pose.quat))

    def send(self, command: Command, host_time: float) -> bool:
        thrust, *rates = command
        if not (self._state & FACTS["armed"] and self._taken):
            thrust = 0.0
            rates = [0.0, 0.0, 0.0]
        share = self.params.thrust.share(thrust)
        rates[2] = self._update_yaw(rates[2], host_time)
        x, y, z = (math.degrees(rate) for rate in rates)
        return self._put(crtp.manual(round(FACTS["manual_thrust"] * share), (x, y, z)))

    def _update_yaw(self, rate: float, host_time: float) -> float:
        """Return the yaw rate to send for a commanded yaw rate [rad/s].

        The firmware integrates the yaw rate to a desired yaw, and the yaw error turns the vehicle.
        In a steady turn the error is ``(1 + D) / P`` times the rate. After a change of the
        commanded rate, the change of this error is added within one period.
        """
        last, when = self._yaw
        self._yaw = rate, host_time
        error = (1.0 + FACTS["yaw_d"]) / FACTS["yaw_p"] * (rate - last)
        return rate + error / max(host_time - when, SHORTEST)

    def surrender(self, host_time: float) -> None:
        """Let it hold the position of its last pose by its own controller, then descend to the
        ground; without poses send nothing, so that its supervisor acts.
        """
        if self._place is None:
            return
        if self._returned is None:
            self._returned = host_time, *self._place
        since, (x, y, z), yaw = self._returned
        lower = DESCENT * max(host_time - since - HOLDS, 0.0)
        self._put(crtp.position((x, y, max(z - lower, 0.0)), yaw))

    def rearm(self) -> None:
        """Forget the last release and close the mechanism, so that the next payload can be
        attached.
        """
        super().rearm()
        self._put(crtp.set_parameter(self.params.release_parameter, 0))

    def service(self, host_time: float) -> None:
        for data in chunks(self._port, self._refuses):
            packet = crtp.unpack(data)
            if packet is None:
                self.roster.drop(self._port.sender, "datagram", "no CRTP packet")
            else:
                self._hear(packet, host_time)
        if host_time - self._asked >= ASK:
            self._asked = host_time
            self._put(crtp.ask_state())
            if not self._speaks:
                self._put(crtp.ask_protocol())
        if self._speaks and not self._state & FACTS["flying"]:  # no parameter is set in flight
            self.audit.service(host_time)
            if self.audit.done:
                self.gyro.service(host_time)
        ready = self._taken and not self._over and self.audit.done and not self.audit.problems
        armed = self._raised or bool(self._state & FACTS["armed"])
        if ready and not armed and host_time - self._armed_at >= ARM_PERIOD:
            self._armed_at = host_time
            self._put(crtp.arm(True))
        if self.release_record.due(host_time):
            self._put(crtp.set_parameter(self.params.release_parameter, 1))

    def finish(self, host_time: float) -> None:
        """Stop the motors and disarm."""
        self._over = True
        self._put(crtp.manual(0, (0.0, 0.0, 0.0)))
        self._put(crtp.arm(False))

    def _hear(self, packet: crtp.Packet, host_time: float) -> None:
        place = (packet.port, packet.channel)
        data = packet.data
        self._speaks = True
        state = FACTS["ask_state"] | FACTS["answer"]
        version = FACTS["ask_protocol"]
        if len(data) < 3:
            return
        if packet.port == FACTS["port_log"]:
            self.gyro.hear(packet.channel, data)
            self.rates = self.gyro.rates
            return
        if (*place, data[0]) == (FACTS["port_supervisor"], FACTS["channel_info"], state):
            self._heard = host_time
            self._state = int.from_bytes(data[1:], "little")
        elif (*place, data[0]) == (FACTS["port_platform"], FACTS["channel_version"], version):
            self.audit.feed("protocol", int.from_bytes(data[1:], "little"))
        elif place == (FACTS["port_param"], FACTS["channel_by_name"]):
            self._hear_set(data[1:-1], data[-1])

    def _hear_set(self, name: bytes, error: int) -> None:
        """Process the answer to a parameter that was set."""
        release = self.params.release_parameter
        for rule in self.audit.rules:
            if name == crtp.encode_name(rule):
                if error == 0:
                    self.audit.feed(rule, float(FACTS.get(rule, 0)))
                else:
                    missing = error == FACTS["no_entry"]
                    self.audit.refuse(rule, NO_SUCH_PARAMETER if missing else error)
        if name == crtp.encode_name(release) and self.release_record.state in (PENDING, ACCEPTED):
            self.release_record.answer(error == 0, "the parameter is not known to the firmware")
