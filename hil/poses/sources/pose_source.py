"""The interface of pose sources, and the source of recorded poses.

Sources raise :class:`hil.errors.SourceError` when they are opened, never when they are polled.
"""

from bisect import bisect_right
from collections.abc import Callable, Iterable

from hil.errors import SourceError
from hil.links.clock import Clock
from hil.links.mavlink_link import Link
from hil.links.roster import Roster
from hil.poses.pose import Pose


class Source:
    """A source of poses; polling never waits and never raises.

    ``rosters`` hold the known senders and count refused traffic.
    """

    ended: bool = False  # whether no further poses will arrive
    stamped: bool = True  # whether stamps are the source's; else they are arrivals

    def __init__(self, links: tuple[Link, ...] = (), clock: Callable[[], float] = lambda: 0.0):
        """Serve links while it is polled; ``clock`` gives the arrivals [s]."""
        self.links = links
        self._clock = clock
        self.rosters = [link.roster for link in links]

    def poll(self, time: float) -> list[Pose]:
        """Return raw poses that have arrived by a ``time`` [s] on the runner's clock, in order of
        arrival.
        """
        raise NotImplementedError

    def wait(self, clock: Clock, until: float) -> None:
        """Wait until a time [s], and process arrivals in the meantime, so that their times are
        recorded.
        """
        while self.links and clock.now() < until:
            clock.wait_for([link.port for link in self.links], until)
            if not self.pump():
                break
        clock.sleep_until(until)

    def pump(self) -> int:
        """Process all arrivals on the links; return 0 if there are none."""
        return sum([link.pump(self._clock) for link in self.links])

    def hold(self, flying: bool) -> None:
        """Set whether the runner flies the vehicle; then no sender's address on the links may
        change.
        """
        for roster in self.rosters:
            roster.flying = flying

    def close(self) -> None:
        """Close ports and files."""
        for link in self.links:
            link.close()


class RecordedSource(Source):
    """A source of recorded poses, each delivered when the runner's clock reaches its arrival."""

    def __init__(self, poses: Iterable[Pose], roster: Roster | None = None):
        """Sort by arrival; poses that arrived together keep their order. ``roster`` counts what of
        the recording is no pose.

        Raises `SourceError` where there is none, or one without an arrival.
        """
        super().__init__()
        self.rosters += [] if roster is None else [roster]
        self.poses = sorted(poses, key=lambda pose: pose.arrival)
        if not self.poses:
            why = (
                "; ".join(f"{n} {entry.text()}" for entry, n in roster.received.items())
                if roster
                else ""
            )
            raise SourceError(
                "the recording holds no pose of a body that the config names"
                + (f": {why}" if why else "")
            )
        self._next = 0

    @property
    def ended(self) -> bool:  # type: ignore[override]
        return self._next >= len(self.poses)

    @property
    def start(self) -> float:
        """Arrival of the first pose [s]."""
        return self.poses[0].arrival

    def poll(self, time: float) -> list[Pose]:
        first = self._next
        self._next = bisect_right(self.poses, time, self._next, key=lambda pose: pose.arrival)
        return self.poses[first : self._next]
