"""What the runner needs of a back-end, the one that sends nothing, and one whose commands wait."""

from collections import deque
from dataclasses import dataclass
from time import perf_counter
from typing import Any

from hil.links.backends.audit import Audit
from hil.links.backends.thrust_curve import HoverThrustParams
from hil.links.device import Port
from hil.links.roster import Address, Announce, Roster, address_text
from visthrow.config.bounds import Bounded, NotNegative, Positive

# how far a release has come
IDLE = "idle"
PENDING = "pending"
ACCEPTED = "accepted"
FAILED = "failed"

WAIT = "wait"
FOLLOW = "follow"
HOLD = "hold"
LAND = "land"
"""What the autopilot does: it is in other hands, follows commands, holds its place by itself, lands
by itself.
"""

Command = tuple[float, ...]
"""Collective thrust [N] and body rates [rad/s], body frame x forward, y left, z up."""

ROUNDING = 1e-6  # tolerance of times that are sums [s]: a microsecond early is in time


@dataclass(frozen=True)
class Status:
    """A back-end's knowledge of its autopilot at a tick; recorded, so that a replay
    decides alike.
    """

    # heard from lately, armed, audited, and in a mode that it was asked for or may be taken from
    connected: bool
    note: str = ""  # why not, for people
    release: str = IDLE  # IDLE, PENDING, ACCEPTED or FAILED
    mode: str = FOLLOW  # WAIT, FOLLOW, HOLD or LAND
    # what ends the run, whatever else is well: a parameter audit that failed
    fault: str | None = None
    # that it hovers with by itself, by its own report and the calibration [N]; None: not known
    thrust: float | None = None
    # body rates that it last reported [rad/s], x forward, y left, z up; None: it reports none
    rates: tuple[float, ...] | None = None


@dataclass(frozen=True)
class BackendParams(Bounded):
    """Settings that every vehicle on the other side has."""

    thrust: HoverThrustParams
    mechanism_lag: NotNegative  # from the release command to separation [s]
    release_timeout: Positive  # without a final answer the release has failed [s]


@dataclass(frozen=True)
class PortVehicleParams(BackendParams):
    """A vehicle on a port of its own."""

    device: str  # see hil.links.device
    remote: bool  # whether the device may leave this machine
    silence: Positive  # after which it counts as lost [s]


class Backend:
    """A receiver of commands whose calls never wait or raise.

    Methods that a subclass does not define do nothing."""

    name = ""
    holds = False  # whether the autopilot has modes of its own that hold a place and land

    def status(self, host_time: float) -> Status:
        """Return what is known now."""
        raise NotImplementedError

    def send(self, command: Command, host_time: float) -> bool:
        """Send a command; whether it was taken."""
        raise NotImplementedError

    def ask(self, mode: str, host_time: float) -> None:
        """Ask for FOLLOW, HOLD or LAND; called at every tick while it is wanted."""

    def release(self, when: float) -> None:
        """Open the mechanism at a time [s] on the runner's clock; called once a throw."""

    def stop_release(self) -> None:
        """Send no (further) release of this throw; one that was sent may still be answered."""

    def rearm(self) -> None:
        """Forget the last throw's release: the operator has armed the next one."""

    def service(self, host_time: float) -> None:
        """Do what is due: heartbeats, the release, its repetition."""

    def due(self) -> float | None:
        """Return when :meth:`service` is to be called at the latest [s]; None for the next tick."""
        return None

    def abort(self, host_time: float) -> None:
        """Ask the autopilot to land; called at every tick of an aborted run.

        A pilot who has taken over is left alone.
        """

    def surrender(self, host_time: float) -> None:
        """Give the vehicle to its own hold, or to the pilot; called at every tick of a run that
        ended so.
        """
        self.ask(HOLD, host_time)

    def finish(self, host_time: float) -> None:
        """Put the autopilot at rest, as far as that is ours: the run is over."""

    def close(self) -> None:
        """Give back ports of its own."""


class DryRun(Backend):
    """Sends nothing."""

    name = "dry-run"
    _release = IDLE

    def status(self, host_time: float) -> Status:
        return Status(True, "dry run", self._release)

    def send(self, command: Command, host_time: float) -> bool:
        return True

    def release(self, when: float) -> None:
        self._release = ACCEPTED

    def rearm(self) -> None:
        self._release = IDLE


class Release:
    """One release: sent at its time, repeated until it is answered, never again once it was
    answered or stopped.

    Attributes:
        state: IDLE, PENDING, ACCEPTED or FAILED. sends: of this throw. note: how it ended. at: of
            the next send [s].
        answers: of all throws, from the first send to the first answer [s].
    """

    REPEAT = 0.04  # between two sends that have no answer yet [s]; answers take 1 to 3 ms

    def __init__(self, timeout: float, read_back: bool = False):
        """Start at rest.

        Without a final answer within the time-out [s], and a movement where it is read back, it has
        failed.
        """
        self.timeout = timeout
        self.read_back = read_back
        self.answers: list[float] = []
        self.open_at_rest = self._begun = False  # the output, before the first release
        self.reset()

    def reset(self) -> None:
        """Forget the last throw."""
        self.state = IDLE
        self.note = ""
        self.sends = 0
        self.at: float | None = None
        self._first = 0.0
        self._sent: float | None = None  # until the first answer
        self._answered = self._moved = self._closed = False

    def start(self, when: float) -> None:
        """Open at a time [s]."""
        if self.state == IDLE:
            self.state = PENDING
            self.at = when
            self._first = when
            self._begun = True
            self.open_at_rest = False

    def stop(self) -> None:
        """Send no more; what was never sent never happened."""
        self.at = None
        if self.state == PENDING and not self.sends:
            self.state = IDLE

    def answer(self, accepted: bool | None, text: str = "") -> None:
        """Take an answer: True accepted, False refused, None at work on it."""
        if self.state != PENDING or not self.sends:
            return
        self.at = None  # heard: not to be sent again
        if self._sent is not None:
            self.answers.append(perf_counter() - self._sent)
            self._sent = None
        if accepted is False:
            self._end(FAILED, text or "refused")
        elif accepted:
            self._answered = True
            self._judge()

    def output(self, is_open: bool) -> None:
        """Note where the mechanism's output is; it has moved when it is open, and was seen closed
        in this throw before.
        """
        self._closed |= not is_open
        self.open_at_rest = is_open and not self._begun
        if is_open and self._closed and self.state == PENDING and self.sends:
            self._moved = True
            self._judge()

    def due(self, host_time: float) -> bool:
        """Return whether to send it now; the caller does."""
        if self.state != PENDING:
            return False
        if host_time - self._first > self.timeout:
            stood = (
                "the output was not seen closed before"
                if self.read_back and not self._closed
                else "nothing moved"
            )
            why = f"accepted, but {stood}" if self._answered else "no final answer"
            self._end(FAILED, f"{why} within {self.timeout:g} s")
        elif self.at is not None and host_time >= self.at - ROUNDING:
            if not self.sends:
                self._sent = perf_counter()
            self.sends += 1
            self.at = host_time + self.REPEAT
            return True
        return False

    def _judge(self) -> None:
        if self._answered and (self._moved or not self.read_back):
            self._end(ACCEPTED, "")

    def _end(self, state: str, note: str) -> None:
        self.state = state
        self.note = note
        self.at = None


class Autopilot(Backend):
    """An autopilot with a release that is answered and settings that are audited; the children
    speak its protocol.

    Attributes:
        audit: of its settings. release_record: of this throw. texts: that it said, the newest last.
        share: last share of thrust that it reported, 0 to 1. voltage: of its battery [V].
        rates: body rates that it last reported [rad/s], x forward, y left, z up.
    """

    audit = Audit()
    release_record: Release
    params: BackendParams
    share: float | None = None
    voltage: float | None = None
    rates: tuple[float, ...] | None = None

    def __init__(self) -> None:
        self.texts: list[str] = []

    def _note(self, host_time: float) -> tuple[str, str]:
        """Return what is wrong, or nothing; and what the autopilot does."""
        raise NotImplementedError

    def _flies_itself(self) -> bool:
        """Return whether it flies, and nothing of ours is followed."""
        return False

    def _hint(self) -> str:
        """Return what it waits for, though nothing is wrong."""
        return ""

    def status(self, host_time: float) -> Status:
        note, mode = self._note(host_time)
        fault = self.audit.fault()
        thrust = None
        if not note and self.release_record.open_at_rest:
            note = "the mechanism's output is at its open end: close it; or its ends are exchanged"
        if self.share is not None and self._flies_itself():
            thrust = self.params.thrust.thrust(self.share, self.voltage)
        reason = note or self._hint() or self.release_record.note
        good = not note and fault is None
        return Status(good, reason, self.release_record.state, mode, fault, thrust, self.rates)

    def release(self, when: float) -> None:
        self.release_record.start(when)

    def stop_release(self) -> None:
        self.release_record.stop()

    def rearm(self) -> None:
        self.release_record.reset()

    def due(self) -> float | None:
        return self.release_record.at


class OnPort(Autopilot):
    """A flight controller on a port of its own that neither holds nor lands by itself: it is taken,
    and given up by silence.

    Where the runner falls silent its own failsafe or watchdog acts; so an abort has nothing to ask
    for. ``dropped`` counts packets that could not be sent, ``roster`` what came and was refused."""

    protocol = ""
    params: PortVehicleParams

    def __init__(self, port: Port, params: PortVehicleParams, tell: Announce = None):
        """Take an open port; ``tell`` is handed who is refused."""
        super().__init__()
        self.params = params
        self.roster = Roster(tell=tell)
        self._port = port
        self._heard = -1e9
        self.dropped = 0
        self._taken = self._raised = self._over = False  # asked for; has followed; over

    def _note(self, host_time: float) -> tuple[str, str]:
        silence = host_time - self._heard
        if silence <= self.params.silence:
            return self._judge()
        return (
            f"no answer by {self.protocol}"
            + (f" for {silence:.1f} s" if self._heard >= 0.0 else ""),
            WAIT,
        )

    def _judge(self) -> tuple[str, str]:
        """Return the same as `_note`, of one that is heard."""
        raise NotImplementedError

    def ask(self, mode: str, host_time: float) -> None:
        self._taken |= mode == FOLLOW

    def close(self) -> None:
        self._port.close()

    def _refuses(self, sender: Address) -> bool:
        """Return whether a datagram is of another sender than the device names, and count it."""
        stranger = self._port.peer not in (None, sender)
        if stranger:
            self.roster.drop(sender, "datagram", f"the device is {address_text(self._port.peer)}")
        return stranger

    def _put(self, data: bytes) -> bool:
        taken = self._port.write(data)
        self.dropped += not taken
        return taken


class Held:
    """A back-end whose commands go out a fixed time later; everything else is its own, the release
    with its own lag too.

    A policy has learnt what its commands do after the trained delay. Poses can be carried forward
    to a slower vehicle's time; for one that acts sooner than the vehicle of the training each
    command waits for the difference."""

    def __init__(self, backend: Backend, hold: float):
        """Hold the commands of a back-end back by a time [s]."""
        self._backend = backend
        self._hold = hold
        self._taken = True
        self._waiting: deque[tuple[float, Command]] = deque()

    def __getattr__(self, name: str) -> Any:
        return getattr(self._backend, name)

    def send(self, command: Command, host_time: float) -> bool:
        """Let a command wait; whether the last one that went out was taken."""
        self._waiting.append((host_time + self._hold, command))
        return self._taken

    def service(self, host_time: float) -> None:
        while self._waiting and self._waiting[0][0] <= host_time + ROUNDING:
            self._taken = self._backend.send(self._waiting.popleft()[1], host_time)
        self._backend.service(host_time)

    def due(self) -> float | None:
        times = [
            time
            for time in (self._backend.due(), self._waiting[0][0] if self._waiting else None)
            if time is not None
        ]
        return min(times, default=None)

    def finish(self, host_time: float) -> None:
        """End; nothing goes out after it."""
        self._waiting.clear()
        self._backend.finish(host_time)
