"""A fake Betaflight on an MSP port; the poses come from the motion capture's bridge, a MAVLink peer
beside it.

A pilot holds it until stick frames come; then the override switch goes on (or, with all channels by
MSP, the arming channel takes it). Silence under the override depends on the version: since 2026.6
the pilot's sticks count again, before that the last frame counts for ever. With all channels by MSP
the motors idle, then it disarms, and an arming channel that is high when the receiver comes back
arms nothing before it was low. Pitch stick forward is nose down. Outputs of CHANNEL_FORWARDING are
not in MSP_SERVO. It hears no poses.

Source: `hil.links.facts`, betaflight."""

import struct
from collections.abc import Callable
from typing import Any

import numpy as np

from hil.links import msp
from hil.links.backends.betaflight import (
    BOX_ARM,
    BOX_OVERRIDE,
    FORWARDING,
    HIGH,
    LOW,
    SETTINGS,
    STICKS,
)
from hil.links.backends.rates import MIDDLE, RATES_TYPES, TRAVEL, RatesParams, Sticks
from hil.links.facts import values
from tests.fakes.ports import ListeningPort, PortFake

FACTS = values("betaflight")
# silence after which the motors idle, with all channels by MSP [s]
IDLE_AFTER = FACTS["receiver_hold"] + FACTS["receiver_recheck"]
# the delay counts from the last look at a receiver that was not lost yet: 1.6 s in all, as the
# firmware in software was measured
RECEIVER_HELD = FACTS["receiver_lost"] - FACTS["receiver_recheck"]
RECEIVER_LOST, LOW_FIRST = FACTS["block_receiver_lost"], FACTS["block_not_disarmed"]
ARM_SWITCH, TILTED = FACTS["block_switch"], FACTS["block_angle"]
REACTION = 0.5  # of the pilot, from the first stick frame to the override switch [s]
ANGLE, FAILSAFE = FACTS["box_angle"], FACTS["box_failsafe"]
BOXES = (BOX_ARM, ANGLE, FAILSAFE, BOX_OVERRIDE)  # permanent ids in the order of the flags
ORDER = tuple(FACTS["rcmap"])  # where roll, pitch, yaw, throttle stand in a frame
MINIMUM = FACTS["min_check"]
RELEASE_AUX, ARM_AUX, OVERRIDE_AUX = 4, 1, 3
SWITCHED = 1700  # a switch above this is on [us]
RANGE = (28, 48)  # steps of a switch's range, of 25 us from 900 us: 1600 to 2100 us

SIZES = {
    msp.RC_TUNING: 24,
    msp.FACTS["MSP_RC_DEADBAND"]: 5,
    msp.FACTS["MSP_RX_CONFIG"]: 7,
    msp.FACTS["MSP_FAILSAFE_CONFIG"]: 8,
}  # bytes of the answers that hold settings


def rate_at(rates: RatesParams, axis: int, us: float) -> float:
    """Return the body rate [rad/s] about our axis at a stick's position [us]."""
    stick = min(max((us - MIDDLE) / TRAVEL, -1.0), 1.0)
    return Sticks.SIGNS[axis] * rates.rate(axis, stick)


class FakeBetaflight(PortFake):
    """See the head of this module."""

    ends = (LOW, HIGH)  # of the mechanism's output, closed and open [us]

    @staticmethod
    def open_port(number: int) -> ListeningPort:
        return ListeningPort(number)

    def __init__(self, *args: Any, **kwargs: Any) -> None:
        super().__init__(*args, **kwargs)
        self.parser = msp.FrameParser()
        if self.options.all_channels:
            self.armed = False
        tuning = {
            "rates_type": RATES_TYPES["actual"],
            "roll_rc_rate": 60,
            "pitch_rc_rate": 60,
            "yaw_rc_rate": 30,
            "roll_rate": 60,
            "pitch_rate": 60,
            "yaw_rate": 30,
            "roll_expo": 0,
            "pitch_expo": 0,
            "yaw_expo": 0,
        }
        self.parameters: dict[str, float] = {
            "deadband": 0,
            "yaw_deadband": 0,
            "min_check": MINIMUM,
            "mid_rc": MIDDLE,
            "failsafe_delay": FACTS["failsafe_delay"],
            "channel_forwarding": 0,
            **tuning,
            **self.options.parameters,
        }
        self._set_rates()
        self.version = (2026, 6, 1)
        self.channels: list[int] = []
        self.override = False
        self._first: float | None = None
        self._heard = -np.inf
        self._low_first = self._disarmed = False

    def _set_rates(self) -> None:
        p, axes = self.parameters, ("roll", "pitch", "yaw")
        kinds = {number: name for name, number in RATES_TYPES.items()}
        three = (
            [int(p[f"{axis}_{what}"]) for axis in axes] for what in ("rc_rate", "rate", "expo")
        )
        self._rates = RatesParams(kinds[int(p["rates_type"])], *map(tuple, three))

    def came(self, data: bytes) -> None:
        for frame in self.parser.parse(data):
            if frame.direction == msp.TO_CONTROLLER and not self.silent:
                self._hear(frame)

    def _hear(self, frame: msp.Frame) -> None:
        answers: dict[int, Callable[[], bytes]] = {
            msp.FACTS["MSP_API_VERSION"]: lambda: bytes([0, 1, 47]),
            msp.FACTS["MSP_FC_VARIANT"]: lambda: b"BTFL",
            msp.FACTS["MSP_FC_VERSION"]: self._version,
            msp.STATUS: self._status,
            msp.RAW_IMU: self._imu,
            msp.RX_MAP: lambda: bytes([*ORDER, 4, 5, 6, 7]),
            msp.BOXIDS: lambda: bytes(BOXES),
            msp.RC: self._rc,
            msp.SERVO: self._servo,
            msp.ANALOG: lambda: struct.pack("<BHHhH", 111, 0, 0, 0, 1110),
            msp.MODE_RANGES: self._ranges,
            msp.EEPROM_WRITE: lambda: b"",
            msp.FACTS["MSP_FEATURE_CONFIG"]: lambda: struct.pack(
                "<I", FORWARDING if self.parameters["channel_forwarding"] else 0
            ),
        }
        answer, direction = b"", msp.ANSWER
        if frame.command == msp.SET_RAW_RC:
            self._sticks_came(list(frame.words()))
        elif frame.command == msp.SET_RC_TUNING and not self.armed:
            offsets = {
                name: setting.offset
                for name, setting in SETTINGS.items()
                if setting.command == msp.RC_TUNING
            }
            self.parameters.update(
                {name: frame.payload[at] for name, at in offsets.items() if at < len(frame.payload)}
            )
            self._set_rates()
        elif frame.command in SIZES:
            answer = self._settings(frame.command)
        elif frame.command in answers:
            answer = answers[frame.command]()
        else:
            direction = msp.REFUSAL
        out = msp.pack(msp.Frame(frame.command, answer, direction))
        self.later(self.options.answer_delay, lambda: self.port.write(out))

    def _version(self) -> bytes:
        first, *rest = self.version
        return bytes([first - FACTS["calendar_base"] if first > 2000 else first, *rest])

    @property
    def window(self) -> float:
        """Silence after which the pilot's sticks count again under the override [s]."""
        since = FACTS["calendar_base"] + FACTS["override_since"][0], FACTS["override_since"][1]
        return FACTS["override_window"] if self.version[:2] >= since else np.inf

    def _settings(self, command: int) -> bytes:
        out = bytearray(SIZES[command])
        for name, setting in SETTINGS.items():
            if setting.command == command:
                struct.pack_into(
                    setting.code,
                    out,
                    setting.offset,
                    round(self.parameters.get(name, 0) / setting.scale),
                )
        return bytes(out)

    def _sticks_came(self, channels: list[int]) -> None:
        if len(channels) < STICKS:
            return
        if any(not FACTS["pulse_least"] <= c <= FACTS["pulse_most"] for c in channels):
            self.witness.command(self.plant.time, (float("nan"),) * 4)
            return
        roll, pitch, yaw, throttle = (channels[at] for at in ORDER)
        rates = tuple(rate_at(self._rates, i, us) for i, us in enumerate((roll, pitch, yaw)))
        share = min(max((throttle - MINIMUM) / (HIGH - MINIMUM), 0.0), 1.0)
        idle = throttle <= MINIMUM
        back = self.plant.time - self._heard > IDLE_AFTER
        self.channels, self._heard = channels, self.plant.time
        self._low_first |= back and not self.armed and channels[STICKS + ARM_AUX - 1] > SWITCHED
        self._first = self.plant.time if self._first is None else self._first
        if self.options.all_channels:
            high = channels[STICKS + ARM_AUX - 1] > SWITCHED
            self._low_first &= high
            if high and not (self.armed or self._low_first) and idle and self.options.arming:
                self.armed = self.override = True
            elif not high:
                self.armed = self.override = False
        self.set_point((0.0 if idle else self.thrust_map.thrust(share), *rates), self.override)
        at = STICKS + RELEASE_AUX - 1
        opened = (
            self.override and at < len(channels) and channels[at] > SWITCHED
        )  # while the channels are ours
        if self.output(opened, self.heard) and self.options.answer not in ("silent", "denied"):
            self.witness.note_answer()

    def _status(self) -> bytes:
        failsafe = self.plant.time - self._heard > IDLE_AFTER
        on = {BOX_ARM: self.armed, BOX_OVERRIDE: self.override, FAILSAFE: failsafe and self.armed}
        flags = sum(1 << i for i, box in enumerate(BOXES) if on.get(box, False))
        blocks = 0 if self.armed or self.options.arming else TILTED
        if self.options.all_channels and not self.armed:
            blocks |= (
                RECEIVER_LOST * (self.plant.time - self._heard > IDLE_AFTER)
                | (LOW_FIRST | ARM_SWITCH) * self._low_first
            )
        return struct.pack("<HHHIBHHBBI", 125, 0, 33, flags, 0, 10, 0, 0, 29, blocks)

    def _rc(self) -> bytes:
        throttle = round(MINIMUM + self.thrust_map.share(self.last_thrust) * (HIGH - MINIMUM))
        channels = [MIDDLE, MIDDLE, MIDDLE, throttle, *([LOW] * 8)]  # the pilot's
        if self.override and self.channels:
            channels = [self.channels[at] for at in ORDER] + self.channels[STICKS:]
        if self.options.answer in (
            "silent",
            "denied",
        ):  # the channel is not in the mask: it never arrives
            channels[STICKS + RELEASE_AUX - 1] = LOW
        return struct.pack(f"<{len(channels)}H", *channels)

    def _servo(self) -> bytes:
        shown = MIDDLE if self.parameters["channel_forwarding"] else self.ends[self.moved]
        return struct.pack("<8H", shown, *([MIDDLE] * 7))

    def _imu(self) -> bytes:
        rates = np.degrees(self.plant.state["rate_b"]).round().astype(int)
        return struct.pack("<9h", 0, 0, 0, *rates, 0, 0, 0)

    def _ranges(self) -> bytes:
        arm = [BOX_ARM, ARM_AUX - 1, *RANGE]
        switch = [] if self.options.all_channels else [BOX_OVERRIDE, OVERRIDE_AUX - 1, *RANGE]
        return bytes([*arm, *switch, 0, 0, 0, 0])

    def take(self) -> None:
        """Switch the override off."""
        self.override = False
        self.stay()
        self.note_event("override off")

    def compute_command(self) -> np.ndarray:
        quiet = self.plant.time - self._heard
        if (
            not (self.options.all_channels or self.taken)
            and self._first is not None
            and self.plant.time - self._first >= REACTION
        ):
            self.override = self.armed
        if not self.override or self._target is None:
            gone = (
                self._first is not None
                and not self.armed
                and (self._disarmed or not self.options.all_channels)
            )
            return np.zeros(4) if gone else self.hold(self._place)
        if not self.options.all_channels:
            if quiet <= self.window:
                self.stay()
                return self._target
            self.note_event("override: the pilot's sticks count again")
            return self.hold(self._place)
        if quiet > IDLE_AFTER:
            self.note_event("failsafe: motors idle")
        if quiet > self.parameters["failsafe_delay"] + RECEIVER_HELD:
            self.armed, self.override, self._disarmed = False, False, True
            self.note_event("failsafe: disarmed")
        return np.zeros(4) if quiet > IDLE_AFTER else self._target

    def report(self) -> dict[str, Any]:
        return {**super().report(), "override": self.override, "parameters": self.parameters}
