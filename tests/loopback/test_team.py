"""Two runners in one process, each with its fake, that throw together or not at all."""

import socket

from pytest import approx, fixture

from bench.processes import free_port
from hil.control.loop import Loop
from hil.control.recording.playback import replay
from hil.control.recording.record import RunRecorder
from hil.links.team_link import MARK, MESSAGE, RELEASE, TeamLink, TeamLinkParams
from tests.hil_flight import AutoOperator, changes
from tests.loopback.wire import peers
from visthrow.throws.wire_plant import make


class Pair:
    """Two loops in lock step, linked over UDP, with the decisions of each."""

    def __init__(self) -> None:
        self.addresses = [("127.0.0.1", free_port()) for _ in range(2)]
        members = tuple(f"{host}:{port}" for host, port in self.addresses)
        self.fakes, self.loops = [], []
        self.decisions: tuple[list, list] = ([], [])
        for k, decisions in enumerate(self.decisions):
            runner, source, clock, fake = peers(make("state", k), seed=k)
            link = TeamLink(TeamLinkParams(k, members), runner.pilot.period)
            loop = Loop(runner, source, clock, AutoOperator(), team=link)
            tick = runner.tick
            runner.tick = lambda *args, tick=tick, to=decisions: to.append(tick(*args)) or to[-1]
            self.fakes.append(fake)
            self.loops.append(loop)

    def turn(self, count: int, until=lambda pair: False) -> None:
        for _ in range(count):
            for loop in self.loops:
                loop.turn(False)
            if until(self):
                return

    def states(self) -> list[str]:
        return [loop.runner.machine.state.value for loop in self.loops]

    def close(self) -> None:
        for loop in self.loops:
            loop.team.close()


@fixture
def pair():
    pair = Pair()
    yield pair
    pair.close()


def throwing(pair: Pair) -> bool:
    return pair.states() == ["throw", "throw"]


def test_both_throw_and_release_in_one_tick(pair, tmp_path):
    first = pair.loops[0]
    first.recorder = RunRecorder(tmp_path / "run", first.runner.params)
    pair.turn(300, lambda pair: all(loop.throws for loop in pair.loops))
    releases = [[d.time for d in each if d.release] for each in pair.decisions]
    starts = [next(d.time for d in each if d.state == "throw") for each in pair.decisions]
    requests = [next(d.time for d in each if d.ready == RELEASE) for each in pair.decisions]
    assert starts[0] == approx(starts[1])
    assert len(releases[0]) == len(releases[1]) == 1
    assert releases[0] == approx(releases[1])
    assert releases[0][0] == approx(max(requests) + 0.02)
    pair.turn(30)
    assert [fake.witness.releases for fake in pair.fakes] == [1, 1]
    first.recorder.close({})
    again = replay(tmp_path / "run")
    assert again["actions"] > 30
    assert again["differences"] == []


def test_a_lost_link_means_no_release_and_the_hover(pair):
    pair.turn(300, throwing)
    for loop in pair.loops:
        loop.team.say = lambda ready: None
    pair.turn(100, lambda pair: "throw" not in pair.states())
    for decisions in pair.decisions:
        assert changes(decisions)[-1] == ("recover", "the team does not throw")
        assert not any(d.release for d in decisions)
    pair.turn(60)
    assert [fake.witness.releases for fake in pair.fakes] == [0, 0]
    assert set(pair.states()) <= {"recover", "ready", "armed"}


def test_lost_words_part_the_releases_by_as_many_ticks(pair):
    """The first one releases by the second one's message, and repeats this until it is received."""
    pair.turn(300, throwing)
    first, second = pair.loops
    say, lost = first.team.say, []

    def lossy(ready: int) -> None:
        at, now = first.runner.latch.at, pair.decisions[0][-1].time
        if ready == RELEASE and (at is None or now < at + 0.03):
            lost.append(ready)
            first.team._agreement.say(ready)
        else:
            say(ready)

    first.team.say = lossy
    pair.turn(100, lambda pair: all(loop.throws for loop in pair.loops))
    assert lost
    assert second.throws[0] - first.throws[0] == approx(0.06)


def test_a_stranger_is_not_heard(pair):
    """It sends the second member's messages from another port."""
    pair.turn(300, throwing)
    first, second = pair.loops
    second.team.say = lambda ready: None
    with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as stranger:
        for _ in range(60):
            pair.turn(1)
            tick = first.team._agreement._now
            stranger.sendto(MESSAGE.pack(MARK, RELEASE, tick), pair.addresses[0])
    assert not first.throws
    assert pair.states()[0] != "throw"
