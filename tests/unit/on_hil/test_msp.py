"""MSP frames: against published bytes, whole and in pieces, and a flood of anything."""

import struct

import numpy as np
from pytest import mark, raises

from hil.links import msp
from hil.links.backends.betaflight import BOX_ARM, Betaflight, settings
from tests.configs import load_run
from tests.fuzz import EACH, SEEDS, mutate, noise
from tests.loopback.wire import pipe

HELLO = msp.Frame(
    msp.STATUS, struct.pack("<HHHIBHHBBI", 125, 0, 33, 1, 0, 10, 0, 0, 29, 0), msp.ANSWER
)
PARAMS = load_run("fake_betaflight").betaflight


def test_published_bytes():
    assert msp.pack(msp.Frame(msp.FACTS["MSP_API_VERSION"])) == bytes.fromhex("244d3c000101")


@mark.parametrize("payload", [b"", b"\x00", b"$M<$X>", bytes(range(200))])
def test_a_round_trip_in_any_pieces(payload):
    frame = msp.Frame(105, payload, msp.ANSWER)
    data = b"noise$" + msp.pack(frame) + b"$M>" + msp.pack(frame)
    for size in (1, 2, 3, 7, len(data)):
        parser, frames = msp.FrameParser(), []
        for at in range(0, len(data), size):
            frames += parser.parse(data[at : at + size])
        assert frame in frames
        assert all(f == frame for f in frames), "nothing else is made of it"


@mark.parametrize(("last", "aux"), [(48, 0.0), (49, 2.0)])
def test_a_mode_whose_range_is_empty_has_no_switch(last, aux):
    frame = msp.Frame(msp.MODE_RANGES, bytes([BOX_ARM, 1, 48, last]), msp.ANSWER)
    assert settings(frame, PARAMS)["arm_aux"] == aux


def test_a_flipped_bit_is_noticed():
    good = msp.pack(HELLO)
    for at in range(3, len(good)):
        for bit in range(8):
            data = bytearray(good)
            data[at] ^= 1 << bit
            assert HELLO not in msp.FrameParser().parse(bytes(data))


def test_what_does_not_fit_is_not_packed():
    for frame in (msp.Frame(300), msp.Frame(1, bytes(255))):
        with raises(ValueError, match="expected at most"):
            msp.pack(frame)


def test_numbers_beyond_the_end_are_none():
    frame = msp.Frame(1, b"\x01\x02\x03")
    assert [
        frame.number(code, at) for code, at in (("B", 2), ("B", 3), ("<H", 1), ("<H", 2), ("<I", 0))
    ] == [3, None, 770, None, None]
    assert frame.words() == (513,)


def fuzz(count: int, seed: int) -> None:
    """Random bytes, mutated frames and whole answers of every command with any content, into parser
    and back-end.
    """
    here, far_end = pipe()
    backend = Betaflight(here, PARAMS)
    rng, sent, parsed = np.random.default_rng(seed), [], msp.FrameParser()
    seeds = [
        msp.pack(msp.Frame(int(c), rng.bytes(int(rng.integers(0, 60))), msp.ANSWER))
        for c in range(256)
    ]
    for i in range(count):
        here.inbox.append(mutate(rng, seeds) if rng.random() < 0.8 else noise(rng))
        if i % 50 == 0:
            backend.service(0.01 * i)
            backend.status(0.01 * i)
            while far_end.inbox:
                sent += [f.command for f in parsed.parse(far_end.inbox.popleft())]
    assert backend.parser.errors > count // 50, "some must be no frames"
    assert {msp.SET_RAW_RC, msp.SET_RC_TUNING, msp.EEPROM_WRITE}.isdisjoint(sent), (
        "nothing of it commands or writes"
    )
    assert backend.release_record.state == "idle"
    assert len(backend.parser._buffer) < 4096, "and nothing piles up"
    answers = backend._heard
    here.inbox.extend([bytes(300), msp.pack(HELLO)])
    backend.service(1e6)
    assert backend._heard == 1e6 > answers, "and the parser works on"


def test_no_bytes_make_the_back_end_raise_or_command():
    fuzz(10_000, 0)


@mark.slow
@mark.parametrize("seed", SEEDS)
def test_a_million_byte_strings(seed):
    fuzz(EACH, seed)


def test_nothing_is_sent_before_the_order_of_the_channels_is_known():
    here, _ = pipe()
    backend = Betaflight(here, load_run("fake_betaflight", ["betaflight.audit=false"]).betaflight)
    modes = msp.Frame(msp.BOXIDS, bytes([0, 1, 27, 50]), msp.ANSWER)
    order = msp.Frame(msp.RX_MAP, bytes([0, 1, 3, 2, 4, 5, 6, 7]), msp.ANSWER)
    for time, frames, known in ((0.1, (HELLO, modes), False), (0.2, (order,), True)):
        here.inbox.extend(map(msp.pack, frames))
        backend.service(time)
        backend.ask("follow", time)
        assert backend.status(time).connected == known
        assert backend.send((2.668, 0.0, 0.0, 0.0), time) == known
