"""Clocks of peers by TIMESYNC: offset, drift, a clock that is set; poses dated by them, and stamps
of another clock.
"""

import numpy as np
from pytest import approx, mark

from hil.links.clock import ManualClock, Ticker, TimeSync
from hil.links.mavlink_link import LATE, Link, LinkSync
from hil.links.pymav import mav
from hil.poses.sources.mavlink import BodyIds, MavlinkSource
from hil.rehearsal.fake import VEHICLE_ID, FakeOptions
from hil.rehearsal.fake_ardupilot import FakeArduPilot
from hil.rehearsal.fake_mocap import FakeMocapParams
from tests.level import LevelPlant
from tests.loopback.wire import HERE, pipe

RATE = 10.0
"""Exchanges a second."""


def exchanges(sync, clock, seconds, start=0.0, most=12e-3):
    """Exchanges with uneven delays of 1 to 12 ms each way; the errors of the offset after each."""
    rng, errors = np.random.default_rng(0), []
    for i in range(int(seconds * RATE)):
        sent = start + i / RATE
        forth, back = rng.uniform(1e-3, most, 2)
        now = sent + forth + back
        sync.take(int(clock(sent + forth) * 1e9), TimeSync.stamp(sent), now)
        errors.append(sync.offset - (clock(now) - now))
    return np.array(errors)


def test_the_shortest_round_trip_is_taken():
    sync = TimeSync()
    errors = exchanges(sync, lambda t: t + 1234.5, 10.0)
    assert abs(errors[-1]) <= 0.5 * sync.round_trip
    assert sync.round_trip < 8e-3, "of 50 exchanges the best"
    assert (TimeSync().offset, TimeSync().round_trip) == (None, None)


def test_a_longer_round_trip_that_comes_later_does_not_count():
    sync, true_offset = TimeSync(), 3.0
    for sent, out, back in ((0.0, 0.002, 0.002), (0.1, 0.009, 0.001)):
        answered = sent + out + true_offset
        sync.take(int(answered * 1e9), TimeSync.stamp(sent), sent + out + back)
    assert sync.offset == approx(true_offset, abs=1e-6)


def test_a_late_tick_skips_those_that_it_missed():
    clock = ManualClock(1.0)
    ticker = Ticker(clock, 0.02)
    ticker.take()
    clock.time = ticker.due() + 0.07
    ticker.take()
    assert (ticker.index, ticker.missed) == (4, 3)
    assert ticker.late == approx(0.01)
    assert ticker.worst == approx(0.07)
    assert ticker.due() == approx(1.1)


@mark.parametrize("drift", [100e-6, -100e-6])
def test_a_drifting_clock_is_followed(drift):
    """100 parts in a million: without forgetting, 60 s would be 6 ms off."""
    sync = TimeSync()
    errors = exchanges(sync, lambda t: 77.0 + (1 + drift) * t, 60.0, most=2e-3)
    assert np.max(np.abs(errors[20:])) < 1.2e-3
    assert sync.steps == 0


@mark.parametrize("step", [1.0, -1.0])
def test_a_clock_that_is_set_is_noticed(step):
    sync = TimeSync()
    exchanges(sync, lambda t: t + 5.0, 5.0)
    errors = exchanges(sync, lambda t: t + 5.0 + step, 2.0, start=5.0)
    assert np.all(np.abs(errors[:2]) > 0.9), "two contradictions may be chance"
    assert np.all(np.abs(errors[2:]) < 0.02), "the third within 0.3 s is a step"
    assert sync.steps == 1


def date_poses(offset, stamp_offset=None):
    """Poses of the fake over a pipe whose clock is off; with ``stamp_offset`` its stamps are of yet
    another clock.
    """
    here, far_end = pipe()
    fake = FakeArduPilot(
        LevelPlant(),
        Link(far_end, *VEHICLE_ID),
        FakeMocapParams(loss=0.0),
        0,
        FakeOptions(clock_offset=offset),
    )
    if stamp_offset is not None:
        plain = fake.wall
        fake.wall = lambda: plain() + stamp_offset
    link = Link(here)
    sync = LinkSync(link)
    source = MavlinkSource(
        link, (BodyIds("vehicle", "ATT_POS_MOCAP", 1, 1),), lambda: fake.plant.time
    )
    poses = []
    for _ in range(round(2.0 / fake.plant.period)):
        fake.step()
        poses += source.poll(fake.plant.time)
    return poses, sync, fake


@mark.parametrize("offset", [0.0, 1.7e9, 333.25])
def test_poses_are_dated_by_their_senders_clock(offset):
    poses, sync, _ = date_poses(offset)
    known = [pose for pose in poses if pose.measured is not None]
    assert len(known) > 150
    assert all(abs(pose.transit(9.9) - 0.01) <= 1e-5 for pose in known[20:])
    assert sync.peers[1, HERE].steps == 0


def test_stamps_of_another_clock_are_not_believed():
    poses, sync, _ = date_poses(0.0, stamp_offset=55.0)
    assert all(pose.measured is None and pose.transit(0.01) == 0.01 for pose in poses)
    assert sync.foreign > 100
    assert LATE < 1.0, "a clock that was set by a second is another clock"


def test_a_peer_that_asks_is_answered_with_our_time():
    here, far_end = pipe()
    ours, peer = Link(here), Link(far_end, *VEHICLE_ID)
    LinkSync(ours)
    heard = []
    peer.listen(lambda message, arrival: heard.append(message))
    peer.send(mav.MAVLink_timesync_message(0, 777))
    ours.pump(lambda: 12.5)
    peer.pump(lambda: 0.0)
    answers = [m for m in heard if m.ts1 == 777]
    assert [m.tc1 for m in answers] == [12_500_000_000]
    # An unrequested answer, and one to an old request, set no clock.
    peer.send(mav.MAVLink_timesync_message(5, 42))
    ours.pump(lambda: 13.0)
    assert not ours.sync.peers
