"""Throws that every member of a team agrees on."""

import numpy as np
from pytest import approx, mark, raises

from bench.processes import free_port
from hil.errors import ConfigError
from hil.links.clock import ManualClock, Ticker
from hil.links.team_link import (
    MARK,
    MESSAGE,
    NOTHING,
    RELEASE,
    THROW,
    WINDOW,
    Agreement,
    TeamLink,
    TeamLinkParams,
)

PERIOD = 0.02


def pair(tick: int = 0) -> tuple[Agreement, Agreement]:
    """Return two members that have begun a tick."""
    members = Agreement(0, 2), Agreement(1, 2)
    for member in members:
        member.begin(tick)
    return members


def test_all_do_in_one_tick_the_least_that_all_were_ready_for():
    members, words = pair(), {3: (1, 0), 4: (0, 2), 6: (1, 2), 7: (2, 2)}
    agreed = []
    for tick in range(10):
        for member in members:
            member.begin(tick)
        agreed.append([member.agreed for member in members])
        first, second = (
            member.say(word) for member, word in zip(members, words.get(tick, (0, 0)), strict=True)
        )
        assert members[0].receive(second, 1)
        assert members[1].receive(first, 0)
    assert agreed == [[0, 0]] * 7 + [[THROW] * 2, [RELEASE] * 2, [0, 0]]


def test_a_lost_or_late_word_stands_for_nothing():
    one, two = pair(5)
    one.say(RELEASE)
    late = two.say(RELEASE)
    one.begin(6)
    assert one.agreed == NOTHING
    one.begin(7)
    assert one.receive(late, 1)
    assert one.agreed == NOTHING


def test_broken_words_and_those_of_another_clock_change_nothing():
    one, rng = Agreement(0, 2), np.random.default_rng(1)
    one.begin(5)
    one.say(RELEASE)
    broken = [b"", MESSAGE.pack(b"VTC1", 1, 5), MESSAGE.pack(MARK, 3, 5)]
    broken += [MESSAGE.pack(MARK, 1, 5 + sign * (WINDOW + 1)) for sign in (-1, 1)]
    broken += [rng.bytes(rng.integers(0, 40)) for _ in range(1000)]
    assert not any(one.receive(datagram, 1) for datagram in broken)
    one.begin(6)
    assert one.agreed == NOTHING


def test_the_first_word_on_a_tick_counts():
    one, two = pair(5)
    one.say(RELEASE)
    one.receive(two.say(THROW), 1)
    one.receive(MESSAGE.pack(MARK, RELEASE, 5), 1)
    one.begin(6)
    assert one.agreed == THROW


def test_two_links_agree_over_udp_on_one_clock():
    """The second runner's clock is 7.3 s behind, and its tick comes 3 ms later."""
    members = tuple(f"127.0.0.1:{free_port()}" for _ in range(2))
    offsets = (100.0, 107.3)
    links = [
        TeamLink(TeamLinkParams(k, members), PERIOD, offset) for k, offset in enumerate(offsets)
    ]
    agreed = []
    try:
        for tick in range(8):
            for k, link in enumerate(links):
                agreed.append(link.agree(200.0 + tick * PERIOD - offsets[k] + 3e-3 * k))
                link.say(RELEASE if tick >= 4 else NOTHING)
    finally:
        for link in links:
            link.close()
    assert agreed == [NOTHING] * 10 + [RELEASE] * 6


@mark.parametrize(
    ("member", "members"),
    [(2, ("127.0.0.1:1", "127.0.0.1:2")), (0, ("127.0.0.1:1",) * 2), (0, ("127.0.0.1:1",))],
)
def test_a_member_outside_of_its_team_is_refused(member, members):
    with raises(ConfigError, match=f"member {member} of"):
        TeamLinkParams(member, members)


@mark.parametrize("grid", [0.0, 1.234])
def test_a_teams_ticks_are_at_multiples_of_its_clock(grid):
    ticker = Ticker(ManualClock(5.013), PERIOD, grid)
    first = ticker.due()
    assert 5.013 <= first < 5.013 + PERIOD
    ticks = (first + grid) / PERIOD
    assert ticks == approx(round(ticks), abs=1e-6)
