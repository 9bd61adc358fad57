"""Runner and fake autopilot in one process, in lock step: no waiting, the same bits on every
machine.
"""

import math
from collections import deque

from hil.control.loop import Loop
from hil.control.tick.runner import Runner
from hil.links.backends import make_backend, mechanism_lag
from hil.links.backends.betaflight import Betaflight
from hil.links.backends.crazyflie import Crazyflie
from hil.links.mavlink_link import Link, LinkSync
from hil.links.pymav import Parser, mav
from hil.links.roster import Roster
from hil.poses.sources.mavlink import MavlinkSource
from hil.poses.sources.open_source import parties
from hil.rehearsal.fake import VEHICLE_ID, Fake, FakeOptions
from hil.rehearsal.fake_mocap import FakeMocapParams
from hil.rehearsal.process import load_fake
from tests.configs import load_run
from tests.fakes import KINDS
from tests.hil_flight import AutoOperator
from tests.mocap_faults import MocapFault
from visthrow.onboard.policy import Policy, find_policy

AUTOPILOTS = ("ardupilot", "px4", "betaflight")
QUICK = (
    "states.check_hold=0.2",
    "states.armed_least=0.1",
    "states.quiet=0.1",
    "states.abort=0.5",
    "states.land=0.5",
)
"""A run whose states last no longer than they must."""

HERE = ("127.0.0.1", 1)
"""Address of the other end."""


def pass_wire(message, system=1, component=1):
    """A message as it comes out of the wire, with its sender."""
    (got,) = Parser().parse(message.pack(mav.MAVLink(None, system, component)))
    return got


class MemoryPort:
    """One end of a pipe of datagrams."""

    whole, peer = True, None

    def __init__(self) -> None:
        self.inbox: deque[bytes | tuple[bytes, tuple[str, int]]] = (
            deque()
        )  # with the sender, where it is not the other end
        self.other: MemoryPort | None = None
        self.sender: tuple[str, int] | None = None

    def read(self) -> bytes | None:
        if not self.inbox:
            return None
        data = self.inbox.popleft()
        data, self.sender = data if isinstance(data, tuple) else (data, HERE)
        return data

    def write(self, data: bytes, to: tuple[str, int] | None = None) -> bool:
        assert to in (None, HERE), "what is sent goes to the other end"
        self.other.inbox.append(bytes(data))
        return True

    def fileno(self) -> int:
        return -1

    def close(self) -> None:
        pass


def pipe() -> tuple[MemoryPort, MemoryPort]:
    """Both ends."""
    a, b = MemoryPort(), MemoryPort()
    a.other, b.other = b, a
    return a, b


class PlantClock:
    """Simulated time; waiting flies on.

    What is sent is heard at that instant, which may lie within a period of the plant.
    """

    def __init__(self, fake: Fake) -> None:
        self._fake, self._now = fake, fake.plant.time
        fake.wall, fake.question_lag = self.now, 0.0

    def now(self) -> float:
        return max(self._now, self._fake.plant.time)

    def _until(self, when: float, port: MemoryPort | None) -> None:
        fake = self._fake
        while self.now() < when - 1e-9:
            fake.hear()
            if port is not None and port.inbox:
                return
            self._now = min(fake.plant.time + fake.plant.period, when)
            if self._now > fake.plant.time + fake.plant.period - 1e-9:
                fake.step()

    def sleep_until(self, when: float) -> None:
        self._until(when, None)

    def wait_for(self, ports: list[MemoryPort], when: float) -> None:
        self._until(when, ports[0])


CONFIGS = {
    "ardupilot": "fake",
    "px4": "fake_px4",
    "betaflight": "fake_betaflight",
    "crazyflie": "fake_crazyflie",
}


def peers(
    plant,
    seed=0,
    answer="accepted",
    overrides=(),
    mocap=None,
    policy="state",
    loaded=None,
    kind="ardupilot",
    tell=None,
    write=False,
    key=None,
    mocap_fault=("none", math.inf),
    **options,
):
    """Runner and fake at the ends of a pipe: runner, source, clock, fake."""

    wild = (
        ("aim.bound=9.0",) if loaded is not None and len(loaded.weights) == 1 else ()
    )  # it releases in hover, 2 m off
    params = load_run(CONFIGS[kind], [f"policy={policy}", *wild, *overrides])
    here, far_end = pipe()
    mine, its = pipe()
    mine.whole = its.whole = kind == "crazyflie"
    more = FakeOptions(answer=answer, **options)
    far = Link(far_end, *VEHICLE_ID, key=key)
    fake = load_fake(KINDS[kind])(plant, far, mocap or FakeMocapParams(), seed, more, its)
    fake.spoil = MocapFault(*mocap_fault, seed).spoil
    roster = Roster(parties(params, True, True))
    clock, link = (
        PlantClock(fake),
        Link(here, params.link.system, params.link.component, roster=roster, key=key),
    )
    if params.delay.synchronise:
        LinkSync(link)
    source = MavlinkSource(link, params.source.senders, clock.now)
    if kind == "betaflight":
        backend = Betaflight(mine, params.betaflight, write, tell)
    elif kind == "crazyflie":
        backend = Crazyflie(mine, params.crazyflie, tell)
    else:
        backend = make_backend(params, link, write, tell)
    loaded = loaded or Policy.load(find_policy(policy))
    runner = Runner(params, loaded, backend, mechanism_lag(params))
    runner.estimator.watcher = getattr(backend, "place", None)
    return runner, source, clock, fake


def cut(runner, source, clock, operator, recorder, seconds, tell):
    """The turns of a run for a time [s], and no more: it is neither aborted nor landed then.

    Its summary.

    ``tell`` gets the first decision of each state; `Loop` itself also reports what a state waits
    for."""
    states = []

    def change(decision):
        if not states or states[-1] != decision.state:
            states.append(decision.state)
            tell(decision)

    loop, begin = Loop(runner, source, clock, operator, recorder, change), clock.now()
    while runner.machine.state != "done" and clock.now() - begin < seconds:
        loop.turn(False)
    return loop.summary()


def throw(plant, seconds=20.0, recorder=None, phase=0, operator=None, **kwargs):
    """A run in lock step, its ticks ``phase`` of the plant's periods after the poses: summary,
    fake, decisions.
    """
    runner, source, clock, fake = peers(plant, **kwargs)
    for _ in range(phase):
        fake.step()
    decisions = []
    summary = cut(
        runner, source, clock, operator or AutoOperator(), recorder, seconds, decisions.append
    )
    return summary, fake, decisions
