"""A release that every member agrees on."""

import numpy as np
import pytest

from visthrow.common.errors import VisthrowError
from visthrow.cooperative.agreement import MESSAGE, Agreement, TeamLink


def test_latches_trip_together_in_the_step_after_all_asked():
    one, two = Agreement(0, 2), Agreement(1, 2)
    asks = {3: (True, False), 4: (False, True), 6: (True, True)}
    tripped = []
    for step in range(10):
        first, second = (
            member.ask(step, asks.get(step, (False, False))[k])
            for k, member in enumerate((one, two))
        )
        decided = one.trips(step), two.trips(step)  # what was sent in this step is under way
        assert one.receive(second)
        assert two.receive(first)
        if any(decided):
            tripped.append((step, decided))
    assert tripped == [(7, (True, True))]


def test_a_lost_or_late_message_is_a_no():
    one = Agreement(0, 2)
    two = Agreement(1, 2)
    one.ask(5, True)
    late = two.ask(5, True)
    assert not one.trips(6)
    assert one.receive(late)
    assert not one.trips(7)


def test_strangers_and_broken_messages_change_nothing():
    one, rng = Agreement(0, 2), np.random.default_rng(1)
    one.ask(5, True)
    own = MESSAGE.pack(b"VTC1", 0, 1, 5)
    third = MESSAGE.pack(b"VTC1", 2, 1, 5)
    broken = [own, third, MESSAGE.pack(b"VTC2", 1, 1, 5), MESSAGE.pack(b"VTC1", 1, 2, 5), b""]
    broken += [rng.bytes(rng.integers(0, 40)) for _ in range(1000)]
    assert not any(one.receive(datagram) for datagram in broken)
    assert not one.trips(6)


def test_a_member_cannot_take_its_word_back_on_a_step():
    one, two = Agreement(0, 2), Agreement(1, 2)
    one.ask(5, True)
    one.receive(two.ask(5, False))
    one.receive(MESSAGE.pack(b"VTC1", 1, 1, 5))
    assert not one.trips(6)


def test_two_runners_agree_over_udp():
    links = [TeamLink(Agreement(k, 2), ("127.0.0.1", 0), []) for k in range(2)]
    for link, other in zip(links, reversed(links), strict=True):
        link._members.append(other.address)
    try:
        decided = [[link.step(step, step >= 4) for link in links] for step in range(8)]
    finally:
        for link in links:
            link.close()
    assert decided[4] == [False, False]
    assert decided[5] == [True, True]


def test_a_member_outside_of_its_team_is_refused():
    with pytest.raises(VisthrowError, match="member 2 of 2"):
        Agreement(2, 2)
