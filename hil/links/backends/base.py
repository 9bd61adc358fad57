"""The interface of the back-ends, the dry run that sends nothing, and a wrapper that delays
commands.
"""

from collections import deque
from dataclasses import dataclass
from time import perf_counter
from typing import Any

from hil.links.backends.audit import Audit
from hil.links.backends.thrust_curve import HoverThrustParams
from hil.links.device import Port
from hil.links.roster import Address, Announce, Roster, address_text
from visthrow.config.bounds import Bounded, NotNegative, Positive

# states of a release
IDLE = "idle"
PENDING = "pending"
ACCEPTED = "accepted"
FAILED = "failed"

WAIT = "wait"
FOLLOW = "follow"
HOLD = "hold"
LAND = "land"
"""Modes of the autopilot: under somebody else's control, following commands, holding its
position by itself, landing by itself.
"""

Command = tuple[float, ...]
"""Collective thrust [N] and body rates [rad/s], body frame x forward, y left, z up."""

ROUNDING = 1e-6  # tolerance of times that are sums [s]


@dataclass(frozen=True)
class Status:
    """The state of the autopilot at a tick, as the back-end knows it. It is recorded, so that a
    replay decides the same.
    """

    # it has answered lately, is armed and audited, and is in a mode that was requested or from
    # which it may be taken
    connected: bool
    note: str = ""  # why it is not connected, for the operator
    release: str = IDLE  # IDLE, PENDING, ACCEPTED or FAILED
    mode: str = FOLLOW  # WAIT, FOLLOW, HOLD or LAND
    # a failed parameter audit, which ends the run in any case
    fault: str | None = None
    # thrust in its own hover, by its report and the calibration [N]; None: unknown
    thrust: float | None = None
    # body rates that it last reported [rad/s], x forward, y left, z up; None: not reported
    rates: tuple[float, ...] | None = None


@dataclass(frozen=True)
class BackendParams(Bounded):
    """Settings that all vehicles share."""

    thrust: HoverThrustParams
    mechanism_lag: NotNegative  # from the release command to separation [s]
    release_timeout: Positive  # time without a final answer after which the release has failed [s]


@dataclass(frozen=True)
class PortVehicleParams(BackendParams):
    """Settings of a vehicle on a separate port."""

    device: str  # see hil.links.device
    remote: bool  # whether the device may be on another machine
    silence: Positive  # after which it counts as lost [s]


class Backend:
    """A receiver of commands whose calls never wait or raise.

    Methods that a subclass does not define do nothing."""

    name = ""
    holds = False  # whether the autopilot has modes that hold the position and land

    def status(self, host_time: float) -> Status:
        """Return the current status."""
        raise NotImplementedError

    def send(self, command: Command, host_time: float) -> bool:
        """Send a command; return whether the port accepted it."""
        raise NotImplementedError

    def ask(self, mode: str, host_time: float) -> None:
        """Request FOLLOW, HOLD or LAND; called at every tick while the mode is wanted."""

    def release(self, when: float) -> None:
        """Open the mechanism at a time [s] on the runner's clock; called once a throw."""

    def stop_release(self) -> None:
        """Send no further release of this throw; a release that was sent may still be answered."""

    def rearm(self) -> None:
        """Forget the last throw's release: the operator has armed the next throw."""

    def service(self, host_time: float) -> None:
        """Send what is due: heartbeats, the release, its repetition."""

    def due(self) -> float | None:
        """Return the time at which :meth:`service` must be called at the latest [s]; None: at
        the next tick.
        """
        return None

    def abort(self, host_time: float) -> None:
        """Ask the autopilot to land; called at every tick of an aborted run.

        Nothing is asked of a vehicle that its pilot has taken over.
        """

    def surrender(self, host_time: float) -> None:
        """Hand the vehicle back to its hold mode or to the pilot; called at every tick of a run
        that ended by handing back.
        """
        self.ask(HOLD, host_time)

    def finish(self, host_time: float) -> None:
        """End the run on the autopilot: disarm it if the runner armed it."""

    def close(self) -> None:
        """Close the back-end's own ports."""


class DryRun(Backend):
    """A back-end that sends nothing."""

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
    """One release: sent at its time, repeated until it is answered, and not sent again once it was
    answered or stopped.

    Attributes:
        state: IDLE, PENDING, ACCEPTED or FAILED. sends: number in this throw. note: why it failed.
            at: time of the next send [s].
        answers: times from the first send to the first answer, of all throws [s].
    """

    REPEAT = 0.04  # between two sends that have no answer yet [s]; answers take 1 to 3 ms

    def __init__(self, timeout: float, read_back: bool = False):
        """Start without a release.

        A release fails without a final answer within the time-out [s], and with ``read_back`` also
        without a movement of the output.
        """
        self.timeout = timeout
        self.read_back = read_back
        self.answers: list[float] = []
        self.open_at_rest = self._begun = False  # of the output, before the first release
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
        """Schedule the release at a time [s]."""
        if self.state == IDLE:
            self.state = PENDING
            self.at = when
            self._first = when
            self._begun = True
            self.open_at_rest = False

    def stop(self) -> None:
        """Send no more; a release that was never sent is forgotten."""
        self.at = None
        if self.state == PENDING and not self.sends:
            self.state = IDLE

    def answer(self, accepted: bool | None, text: str = "") -> None:
        """Process an answer: True accepted, False refused, None in progress."""
        if self.state != PENDING or not self.sends:
            return
        self.at = None  # answered: not to be sent again
        if self._sent is not None:
            self.answers.append(perf_counter() - self._sent)
            self._sent = None
        if accepted is False:
            self._end(FAILED, text or "refused")
        elif accepted:
            self._answered = True
            self._judge()

    def output(self, is_open: bool) -> None:
        """Process a read-back of the mechanism's output. It has moved if it is open now and was
        closed before in this throw.
        """
        self._closed |= not is_open
        self.open_at_rest = is_open and not self._begun
        if is_open and self._closed and self.state == PENDING and self.sends:
            self._moved = True
            self._judge()

    def due(self, host_time: float) -> bool:
        """Return whether the caller has to send the release now."""
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
    """An autopilot that answers the release and whose settings are audited; subclasses implement
    its protocol.

    Attributes:
        audit: of its settings. release_record: of this throw. texts: messages of the autopilot, the
            newest last.
        share: share of full thrust that it last reported, 0 to 1. voltage: of its battery [V].
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
        """Return the problem ("" if there is none) and the autopilot's mode."""
        raise NotImplementedError

    def _flies_itself(self) -> bool:
        """Return whether it flies without following the runner."""
        return False

    def _hint(self) -> str:
        """Return what it waits for while there is no problem."""
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
    """A flight controller on a separate port that neither holds nor lands by itself.

    The runner gives it up by sending nothing: then its failsafe or watchdog acts, so an abort
    requests nothing. ``dropped`` counts packets that could not be sent, ``roster`` those that were
    received and refused."""

    protocol = ""
    params: PortVehicleParams

    def __init__(self, port: Port, params: PortVehicleParams, tell: Announce = None):
        """Use an open port; ``tell``: called with each refused sender."""
        super().__init__()
        self.params = params
        self.roster = Roster(tell=tell)
        self._port = port
        self._heard = -1e9
        self.dropped = 0
        self._taken = self._raised = self._over = False  # requested; has followed; the run is over

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
        """Return problem and mode as `_note`, for a flight controller that answers."""
        raise NotImplementedError

    def ask(self, mode: str, host_time: float) -> None:
        self._taken |= mode == FOLLOW

    def close(self) -> None:
        self._port.close()

    def _refuses(self, sender: Address) -> bool:
        """Return whether a datagram is from another sender than the device names; count it if
        so.
        """
        stranger = self._port.peer not in (None, sender)
        if stranger:
            self.roster.drop(sender, "datagram", f"the device is {address_text(self._port.peer)}")
        return stranger

    def _put(self, data: bytes) -> bool:
        taken = self._port.write(data)
        self.dropped += not taken
        return taken


class Held:
    """A wrapper that delays a back-end's commands by a fixed time; everything else, including the
    release, goes to the back-end at once.

    A policy is trained with a certain delay of its commands. For a vehicle with a longer delay,
    poses are predicted further ahead; for a vehicle with a shorter one, each command waits for the
    difference."""

    def __init__(self, backend: Backend, hold: float):
        """Delay the commands of a back-end by ``hold`` [s]."""
        self._backend = backend
        self._hold = hold
        self._taken = True
        self._waiting: deque[tuple[float, Command]] = deque()

    def __getattr__(self, name: str) -> Any:
        return getattr(self._backend, name)

    def send(self, command: Command, host_time: float) -> bool:
        """Queue a command; return whether the port accepted the last one that was sent."""
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
        """Discard the waiting commands and finish."""
        self._waiting.clear()
        self._backend.finish(host_time)
