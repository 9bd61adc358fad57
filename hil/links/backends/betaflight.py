"""Back-end of Betaflight over MSP: rates and thrust as stick positions, the release on an AUX
channel.

The flight controller has no hold mode and uses no poses, so the runner's hover controller flies
before and after the throw. It accepts the runner's channels in two ways. MSP OVERRIDE
(``arm_channel = 0``): a receiver supplies all channels, and while the pilot holds a switch the
runner supplies the four sticks and the release channel. If the runner dies, the last sticks stay in
force until the pilot releases the switch; since 2026.6 the receiver's channels return soon by
themselves. RX_MSP (``arm_channel`` an AUX): the runner supplies all channels, for benches and
software only; without frames the motors idle, then the vehicle disarms.

MSP_SERVO does not show the outputs of CHANNEL_FORWARDING; with it, the release is read back from
its channel only. If ARM is raised while the receiver is in failsafe, it has to go low again before
the firmware arms.

Source: `hil.links.facts`, betaflight; betaflight.com, Controlling Betaflight From a Companion
Computer Over MSP."""

import math
import struct
from dataclasses import dataclass
from typing import Annotated

from hil.links import msp
from hil.links.backends.audit import Audit, Rule, rules_of
from hil.links.backends.base import (
    ACCEPTED,
    FOLLOW,
    PENDING,
    ROUNDING,
    WAIT,
    Command,
    OnPort,
    PortVehicleParams,
    Release,
)
from hil.links.backends.rates import MIDDLE, RATES_TYPES, RatesParams, Sticks
from hil.links.device import Port, chunks
from hil.links.facts import values
from hil.links.roster import Announce
from visthrow.common.errors import ConfigError
from visthrow.config.bounds import Bound

FACTS = values("betaflight")
# permanent ids of flight modes
BOX_ARM = FACTS["box_arm"]
BOX_OVERRIDE = FACTS["box_override"]
STICKS = FACTS["sticks"]  # channels before the first AUX
# ends of a channel [us]
LOW = FACTS["low"]
HIGH = FACTS["high"]
FORWARDING = FACTS["forwarding"]  # bit of CHANNEL_FORWARDING in MSP_FEATURE_CONFIG
BLOCKS = FACTS["blocks"]
"""Texts of the arming-disabled flags of MSP_STATUS, by bit. The highest bit of a version is the
ARM switch itself; it is set if the switch was raised while another flag was set.
"""

EXPIRES = FACTS["calendar_base"] + FACTS["override_since"][0] + 0.01 * FACTS["override_since"][1]
"""First version (year and month) in which the sticks of MSP OVERRIDE expire."""

FEWEST_AUX = 4  # channels of a frame beside the sticks
IMU = struct.Struct(f"<{FACTS['imu_rates']}x3h")  # body rates of MSP_RAW_IMU
ARRIVED = 50  # tolerance within which a channel or output has reached its target [us]
# between two frames while nothing is commanded yet: without frames it cannot be armed [s]
KEEP_ALIVE = 0.02
# after which the mechanism closes again, so that the next payload can be attached [s]
OPEN_TIME = 2.0
# for which no arming-disabled flag may be set before ARM is raised (again) [s]
ARM_LOW = 0.5

# messages that are requested all the time, and their periods [s]
POLLS = {msp.STATUS: 0.1, msp.RC: 0.1, msp.SERVO: 0.1, msp.RAW_IMU: 0.1, msp.ANALOG: 1.0}

READ_BACK = 0.04
"""Between two requests for the state of the release [s].

The firmware processes one command in each cycle of its serial task, 100 per second by default. With
one or two requests beside every frame, the frames queued up and were 0.1 to 0.3 s late just after a
release.
"""

RATES_PERIOD = 0.02
RATES_TIME = 0.2
"""Between two requests for body rates [s], and for how long they are requested after it begins
to follow [s]. In this time the signs of its rates show; longer requests would make frames queue
up.
"""

AXES = ("roll", "pitch", "yaw")


@dataclass(frozen=True)
class BetaflightParams(PortVehicleParams):
    """Settings of a Betaflight vehicle."""

    rates: RatesParams
    minimum_us: Annotated[
        int, Bound(900, 1200)
    ]  # min_check: largest throttle that counts as 0 [us]
    # AUX channel that arms, from 1; 0: the pilot arms and hands over by MSP OVERRIDE
    arm_channel: Annotated[int, Bound(0, 12)]
    release_channel: Annotated[int, Bound(1, 12)]  # AUX channel of the mechanism, from 1
    servo_output: int  # output of MSP_SERVO that drives the mechanism, from 1; 0: not read back
    servo_open_us: int  # value of that output with the mechanism open [us]
    audit: bool  # whether settings are read when it connects, and a mismatch prevents the flight

    def __post_init__(self) -> None:
        super().__post_init__()
        if self.arm_channel == self.release_channel:
            raise ConfigError(
                f"arm_channel and release_channel are both AUX {self.arm_channel}; expected two"
            )


class Betaflight(OnPort):
    """The back-end of a Betaflight flight controller; ``refused`` counts commands unknown to it."""

    name = "betaflight"
    protocol = "MSP"
    params: BetaflightParams

    def __init__(
        self,
        port: Port,
        params: BetaflightParams,
        write: bool = False,
        tell: Announce = None,
    ):
        """Use MSP on an open port; ``write``: whether to correct wrong rates; ``tell``: called
        with the table of settings.
        """
        super().__init__(port, params)
        self.parser = msp.FrameParser()
        self.sticks = Sticks(params.rates)
        self.release_record = Release(params.release_timeout, params.servo_output > 0)
        self.audit = Audit(
            self._rules() if params.audit else (),
            lambda name: self._write(SETTINGS[name].command),
            self._write_setting if write else None,
            tell,
        )
        # rcmap: positions of roll, pitch, yaw and throttle in a frame; empty: not reported yet
        self._order: list[int] = []
        self._boxes: tuple[int, ...] = ()
        self._tuning = b""
        self._polled = dict.fromkeys(POLLS, -1e9)
        self._framed = self._boxed = self._read_back = -1e9
        self._followed_at: float | None = None  # when it began to follow [s]
        self._flags = self._blocks = 0
        # since when no arming-disabled flag is set, with ARM low
        self._free_since: float | None = None
        self._sticks_us = (MIDDLE, MIDDLE, MIDDLE, LOW)  # roll, pitch, yaw, throttle
        self._pilots_us = LOW  # the pilot's last throttle
        self._opened: float | None = None
        self.refused = 0

    def _rules(self) -> list[Rule]:
        p = self.params
        curves = {"rc_rate": p.rates.rc_rates, "rate": p.rates.rates, "expo": p.rates.expo}
        numbers = {
            f"{axis}_{name}": curve[i]
            for name, curve in curves.items()
            for i, axis in enumerate(AXES)
        }
        numbers |= {"rates_type": RATES_TYPES[p.rates.type], "expires": EXPIRES}
        return rules_of(self.name, p, **numbers)

    def _hint(self) -> str:
        if not self._taken or self._raised:
            return ""
        if self.params.arm_channel:
            return (
                f"arming disabled: {describe_blocks(self._blocks)}"
                if self._blocks
                else "it is being armed"
            )
        return "" if self._box(BOX_OVERRIDE) else "MSP OVERRIDE is off: switch it on to hand over"

    def _flies_itself(self) -> bool:
        return not self._taken and self._box(BOX_ARM) and not self._box(BOX_OVERRIDE)

    def _judge(self) -> tuple[str, str]:
        if not (self.audit.done and self._boxes and self._order):
            return "settings are being read", WAIT
        has_all = self.params.arm_channel > 0  # the runner supplies all channels
        armed = self._box(BOX_ARM)
        ours = has_all or self._box(BOX_OVERRIDE)
        if armed and ours and self._taken:
            self._raised = True
            return "", FOLLOW
        if self._taken and self._raised:
            return "MSP OVERRIDE is off: the pilot has it" if armed else "disarmed", WAIT
        if has_all:
            blocks = self._blocks and not self._taken
            return f"arming disabled: {describe_blocks(self._blocks)}" if blocks else "", WAIT
        if not armed:
            return "disarmed", WAIT
        early = ours and not self._taken
        return "MSP OVERRIDE is on before the runner is ready: switch it off" if early else "", WAIT

    def _box(self, number: int) -> bool:
        return is_on(number, self._boxes, self._flags)

    def send(self, command: Command, host_time: float) -> bool:
        thrust, *rates = command
        share = self.params.thrust.share(thrust, self.voltage)
        low = self.params.minimum_us
        # arming requires low throttle
        waiting = self.params.arm_channel and not self._box(BOX_ARM)
        throttle = LOW if waiting else round(low + share * (HIGH - low))
        self._sticks_us = (*(self.sticks.position(i, r) for i, r in enumerate(rates)), throttle)
        return self._frame(host_time)

    def _frame(self, host_time: float) -> bool:
        p = self.params
        if not self._order:  # no frame before the channel order is known
            return False
        channels = [LOW] * (STICKS + max(FEWEST_AUX, p.arm_channel, p.release_channel))
        for i, value in enumerate(self._sticks_us):
            channels[self._order[i]] = value
        if p.arm_channel:
            channels[STICKS + p.arm_channel - 1] = HIGH if self._arms(host_time) else LOW
        channels[STICKS + p.release_channel - 1] = LOW if self._opened is None else HIGH
        self._framed = host_time
        return self._write(msp.SET_RAW_RC, struct.pack(f"<{len(channels)}H", *channels))

    def _arms(self, host_time: float) -> bool:
        """Return whether ARM has to be high: once no arming-disabled flag has been set for a
        while, and as long as none is set before it is armed.
        """
        if not self._taken or self._over:
            return False
        return self._box(BOX_ARM) or (
            self._free_since is not None and host_time - self._free_since >= ARM_LOW
        )

    def stop_release(self) -> None:
        """Send no further release; if the release is not confirmed, set its channel low again,
        so that the mechanism does not open later.
        """
        super().stop_release()
        if self.release_record.state != ACCEPTED:
            self._opened = None

    def rearm(self) -> None:
        super().rearm()
        self._opened = None

    def service(self, host_time: float) -> None:
        for data in chunks(self._port):
            for frame in self.parser.parse(data):
                if frame.direction == msp.ANSWER:
                    self._hear(frame, host_time)
                elif frame.direction == msp.REFUSAL:
                    self.refused += 1
        if self._raised and self._followed_at is None:
            self._followed_at = host_time
        self._poll(host_time)
        if self._boxes and self._heard > 0.0:  # nothing is written while armed
            self.audit.service(host_time)
        self._serve_release(host_time)
        ours = self.params.arm_channel and not self._taken and not self._over
        if ours and host_time - self._framed >= KEEP_ALIVE:
            self._frame(host_time)

    def _poll(self, host_time: float) -> None:
        """Send the requests that are due."""
        judged = self._followed_at is not None and host_time - self._followed_at <= RATES_TIME
        periods = POLLS | ({msp.RAW_IMU: RATES_PERIOD} if judged else {})
        if not self.release_record.read_back:
            del periods[msp.SERVO]
        for command, period in periods.items():
            if host_time - self._polled[command] >= period - ROUNDING:
                self._polled[command] = host_time
                self._write(command)
        if not (self._boxes and self._order) and host_time - self._boxed >= 0.5:
            self._boxed = host_time
            self._write(msp.BOXIDS)
            self._write(msp.RX_MAP)

    def _serve_release(self, host_time: float) -> None:
        """Open the mechanism, request its state, and close it after a while."""
        if self.release_record.due(host_time) and self._opened is None:
            self._opened = host_time
            self._frame(host_time)
        if self._opened is None:
            return
        waits = self.release_record.state == PENDING
        if waits and host_time - self._read_back >= READ_BACK:
            self._read_back = host_time
            if self.release_record.read_back:
                self._write(msp.SERVO)
            self._write(msp.RC)
        if host_time - self._opened > OPEN_TIME:
            self._opened = None

    @property
    def _expires(self) -> bool:
        """Whether the last sticks expire without further frames."""
        return self.audit.found.get("fc_version", 0.0) >= EXPIRES - 1e-6

    def surrender(self, host_time: float) -> None:
        """Hand the vehicle back to the pilot: send nothing if the sticks expire; else keep it level
        with the pilot's last throttle, until the pilot releases the switch.

        If the runner supplies all channels, sending nothing triggers the failsafe.
        """
        if self.params.arm_channel or self._expires:
            return
        self._sticks_us = (MIDDLE, MIDDLE, MIDDLE, self._pilots_us)
        self._frame(host_time)

    def finish(self, host_time: float) -> None:
        """Disarm, if the runner supplies the arming channel."""
        self._over = True
        self._sticks_us = (MIDDLE, MIDDLE, MIDDLE, LOW)
        if self.params.arm_channel:
            self._frame(host_time)

    def _write(self, command: int, payload: bytes = b"") -> bool:
        return self._put(msp.pack(msp.Frame(command, payload)))

    def _hear(self, frame: msp.Frame, host_time: float) -> None:
        if frame.command == msp.STATUS:
            self._heard = host_time
            self._hear_status(frame)
            if self._blocks:
                self._free_since = None
            elif self._free_since is None:
                self._free_since = host_time
        elif frame.command in _HANDLERS:
            _HANDLERS[frame.command](self, frame)
        for name, value in settings(frame, self.params).items():
            self.audit.feed(name, value)
            if name == "channel_forwarding" and value:
                self.release_record.read_back = False

    def _hear_rates(self, frame: msp.Frame) -> None:
        if len(frame.payload) >= IMU.size:
            self.rates = tuple(map(math.radians, IMU.unpack_from(frame.payload)))

    def _hear_voltage(self, frame: msp.Frame) -> None:
        volts = frame.number("<H", FACTS["analog_volts"])
        if volts:
            self.voltage = 0.01 * volts

    def _hear_outputs(self, frame: msp.Frame) -> None:
        p = self.params
        outputs = frame.words()
        if 1 <= p.servo_output <= len(outputs):
            self.release_record.output(
                abs(outputs[p.servo_output - 1] - p.servo_open_us) <= ARRIVED
            )

    def _hear_boxes(self, frame: msp.Frame) -> None:
        self._boxes = tuple(frame.payload)

    def _hear_order(self, frame: msp.Frame) -> None:
        first = list(frame.payload[:STICKS])
        if sorted(first) == list(range(STICKS)):
            self._order = first

    def _hear_tuning(self, frame: msp.Frame) -> None:
        if not self.audit.written:
            self._tuning = frame.payload

    def _hear_status(self, frame: msp.Frame) -> None:
        flags = frame.number("<I", FACTS["status_flags"])
        count = frame.number("B", FACTS["status_more"])
        if flags is None or count is None:
            return
        start = FACTS["status_more"] + 1
        end = start + (count & FACTS["status_more_mask"])
        further = int.from_bytes(frame.payload[start:end], "little")
        self._flags = flags | further << FACTS["status_flag_bits"]
        self._blocks = frame.number("<I", end + 1) or 0

    def _hear_channels(self, frame: msp.Frame) -> None:
        """Process MSP_RC: roll, pitch, yaw, throttle, AUX 1 and so on, independent of rcmap."""
        p = self.params
        channels = frame.words()
        if len(channels) < STICKS:
            return
        if not self._box(BOX_OVERRIDE):
            self._pilots_us = channels[3]
        self.share = min(max((channels[3] - p.minimum_us) / (HIGH - p.minimum_us), 0.0), 1.0)
        index = STICKS + p.release_channel - 1
        if index < len(channels) and abs(channels[index] - HIGH) <= ARRIVED:
            self.release_record.answer(True)

    def _write_setting(self, name: str, value: float) -> None:
        """Write a value of the rate profile and save it; never while armed."""
        setting = SETTINGS[name]
        if (
            setting.command != msp.RC_TUNING
            or len(self._tuning) <= setting.offset
            or self._box(BOX_ARM)
        ):
            return
        changed = bytearray(self._tuning)
        changed[setting.offset] = int(value)
        self._tuning = bytes(changed)
        self._write(msp.SET_RC_TUNING, self._tuning)
        self._write(msp.EEPROM_WRITE)


_HANDLERS = {
    msp.RC: Betaflight._hear_channels,
    msp.RAW_IMU: Betaflight._hear_rates,
    msp.ANALOG: Betaflight._hear_voltage,
    msp.SERVO: Betaflight._hear_outputs,
    msp.BOXIDS: Betaflight._hear_boxes,
    msp.RX_MAP: Betaflight._hear_order,
    msp.RC_TUNING: Betaflight._hear_tuning,
}
"""Answer -> the method that processes it; other answers only hold settings."""


@dataclass(frozen=True)
class AnswerField:
    """The position of a setting in an answer."""

    command: int
    offset: int  # in the payload
    code: str = "B"  # as of `struct`
    scale: float = 1.0


SETTINGS = {
    name.removeprefix("tells_"): AnswerField(FACTS[row[0]], *row[1:])
    for name, row in FACTS.items()
    if name.startswith("tells_")
}
"""Setting -> its field in an answer. Some settings are more than a number: see :func:`settings`."""


def is_on(box: int, boxes: tuple[int, ...], flags: int) -> bool:
    """Return whether a flight mode is on, from MSP_BOXIDS and the flags of MSP_STATUS."""
    return box in boxes and bool(flags >> boxes.index(box) & 1)


def describe_blocks(flags: int) -> str:
    """Return a text of the arming-disabled flags."""
    named = [text for bit, text in enumerate(BLOCKS) if flags >> bit & 1]
    return f"{', '.join(named) or 'ARM switch'} (flags {flags:#x})"


def settings(frame: msp.Frame, params: BetaflightParams) -> dict[str, float]:
    """Return the settings in an answer; truncated fields are left out."""
    mine = {name: setting for name, setting in SETTINGS.items() if setting.command == frame.command}
    values = {
        name: float(setting.scale * n)
        for name, setting in mine.items()
        if (n := frame.number(setting.code, setting.offset)) is not None
    }
    for name in {"api_version", "fc_version"} & values.keys():
        minor = frame.number("B", SETTINGS[name].offset + 1)
        values = {} if minor is None else {name: values[name] + 0.01 * minor}
    if values.get("fc_version", 0.0) >= FACTS["calendar"]:
        values["fc_version"] += FACTS["calendar_base"]
    if "channel_forwarding" in values:
        values["channel_forwarding"] = float(bool(int(values["channel_forwarding"]) & FORWARDING))
    if frame.command == msp.MODE_RANGES:
        values = {
            "arm_aux": _aux(frame, BOX_ARM, params.arm_channel),
            "override_aux": _aux(frame, BOX_OVERRIDE, 0),
        }
    return values


def _aux(frame: msp.Frame, box: int, preferred: int) -> float:
    """Return the AUX channel, from 1, of a flight mode by MSP_MODE_RANGES (box, channel, first
    and last step of 25 us); 0: none.
    """
    size = FACTS["range_bytes"]
    starts = range(0, len(frame.payload) - size + 1, size)
    entries = [frame.payload[start : start + size] for start in starts]
    channels = [
        channel + 1 for box_id, channel, first, last in entries if box_id == box and first < last
    ]
    return float(preferred if preferred in channels else channels[0] if channels else 0)
