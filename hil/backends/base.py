"""What the runner needs of a back-end, and the one that sends nothing."""

from dataclasses import dataclass
from typing import Protocol

IDLE, PENDING, ACCEPTED, FAILED = "idle", "pending", "accepted", "failed"
"""How far a release has come."""


@dataclass(frozen=True)
class Status:
    """What a back-end knows of its autopilot at a tick; recorded, so that a replay decides alike."""

    connected: bool  # heard from lately, armed, and in a mode that follows commands
    note: str = ""  # why not, for people
    release: str = IDLE  # IDLE, PENDING, ACCEPTED or FAILED


class Backend(Protocol):
    """Where commands go; no call waits or raises."""

    name: str

    def status(self, now: float) -> Status:
        """What is known now."""

    def send(self, command: tuple[float, ...], now: float) -> bool:
        """Send collective thrust [N] and body rates [rad/s], body frame x forward, y left, z up; whether it was taken."""

    def release(self, when: float) -> None:
        """Open the mechanism at a time [s] on the runner's clock; called once a throw."""

    def stop_release(self) -> None:
        """Send no (further) release of this throw."""

    def service(self, now: float) -> None:
        """Do what is due: heartbeats, the release, its repetition."""

    def due(self) -> float | None:
        """When :meth:`service` is to be called at the latest [s]; None for the next tick."""

    def abort(self, now: float) -> None:
        """Ask the autopilot to take over; called at every tick of an aborted run."""


class DryRun:
    """Sends nothing; counts what it was given."""

    name = "dry-run"

    def __init__(self) -> None:
        """Start with nothing sent."""
        self.commands = self.releases = 0
        self._release = IDLE

    def status(self, now: float) -> Status:
        """See `Backend`."""
        return Status(True, "dry run", self._release)

    def send(self, command: tuple[float, ...], now: float) -> bool:
        """See `Backend`."""
        self.commands += 1
        return True

    def release(self, when: float) -> None:
        """See `Backend`."""
        self.releases += 1
        self._release = ACCEPTED

    def stop_release(self) -> None:
        """See `Backend`."""
        self._release = IDLE

    def service(self, now: float) -> None:
        """See `Backend`."""

    def due(self) -> float | None:
        """See `Backend`."""
        return None

    def abort(self, now: float) -> None:
        """See `Backend`."""
