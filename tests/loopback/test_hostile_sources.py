"""Sources of poses against hostile datagrams: truncated, random and forged datagrams and frames end
no thread, change no throw, and are counted.
"""

import socket
import threading
import time

from pytest import fixture, importorskip, mark

from bench.hostile import READERS, judge
from hil.poses.sources.motion_capture import (
    MocapParams,
    NatNetSource,
    RigidBody,
)
from tests.fuzz import EACH, SEEDS
from tests.motive import Motive, frame
from tests.waiting import eventually

IDS = (RigidBody("vehicle", "7"), RigidBody("payload", "8"))
LEVEL, UNKNOWN = (0.0, 0.0, 0.0, 1.0), (0.0, 0.0, 0.0, 0.0)


@fixture
def motive():
    server = Motive()
    yield server
    server.close()


@fixture
def natnet(motive):
    importorskip("natnet", reason="extra natnet")
    messages = []
    params = MocapParams("natnet", "127.0.0.1", multicast=False, timeout=10.0)
    source = NatNetSource(params, IDS, time.monotonic, tell=messages.append)
    yield source, messages
    source.close()


def test_bad_datagrams_end_no_thread_of_natnet(motive, natnet):
    source, messages = natnet
    threads = [thread for thread in threading.enumerate() if "socket_thread" in thread.name]
    assert len(threads) == 2
    good = frame(1.0, (7, (0.5, 1.0, 0.0), LEVEL, True), (8, (0.5, 0.4, 0.0), UNKNOWN, False))
    counts = frame(1.5)
    bomb = counts[:28] + b"\1\0\0\0" + b"\0\0\0\0" + b"\1\0\0\0" + b"\xff\xff\xff\x3f" + counts[44:]
    for data in (good[:-1], b"\7", b"\7\0\4\0\1\0\0\0", b"\7\0\0\0", b"noise", b"", bomb):
        motive.send(data)
    stranger = socket.socket(socket.AF_INET, socket.SOCK_DGRAM)
    stranger.bind(("127.0.0.9", 0))
    stranger.sendto(frame(2.0, (7, (9.0, 9.0, 9.0), LEVEL, True)), motive.client)
    eventually(lambda: source.roster.refused == 8)
    motive.send(good)
    second = socket.socket(socket.AF_INET, socket.SOCK_DGRAM)
    second.bind(("127.0.0.1", 0))
    eventually(lambda: len(source._waiting) == 2)
    second.sendto(frame(3.0, (7, (9.0, 9.0, 9.0), LEVEL, True)), motive.client)
    eventually(lambda: source.roster.refused == 9)
    vehicle, payload = source.poll(0.0)
    assert (vehicle.body, vehicle.pos, vehicle.stamp, vehicle.valid) == (
        "vehicle",
        (0.5, 1.0, 0.0),
        1.0,
        True,
    )
    assert not payload.valid
    assert all(thread.is_alive() for thread in threads)
    assert source.failure is None
    assert sum("does not parse" in text for text in messages) >= 1
    assert any(
        "source.mocap.host is 127.0.0.1" in text and "127.0.0.9" in text for text in messages
    )
    assert any(
        "a second sender; the Motive speaks from 127.0.0.1:1510" in text for text in messages
    )
    stranger.close()
    second.close()


@mark.parametrize("kind", READERS)
def test_hostile_items_change_no_throw(kind):
    if kind == "natnet":
        importorskip("natnet", reason="extra natnet")
    assert judge(kind, 0, 3000) == 3000


@mark.slow
@mark.parametrize("seed", SEEDS)
@mark.parametrize("kind", READERS)
def test_a_million_hostile_items_change_no_throw(kind, seed):
    judge(kind, seed, EACH)
