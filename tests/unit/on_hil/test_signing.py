"""MAVLink signing: keys, accepted and refused messages; pymavlink's check is the oracle for what we
send.
"""

import hashlib
import time

from pytest import mark, raises

from hil.errors import LinkError
from hil.links.mavlink_link import Link
from hil.links.pymav import EPOCH, LAG_LIMIT, Signed, mav, read_key, stamp_now
from tests.loopback.wire import pipe

KEY = bytes(range(32))
WORD = mav.MAVLink_heartbeat_message(2, 3, 0, 0, 0, 3)


def pair(theirs=KEY):
    here, far_end = pipe()
    got, link, peer = [], Link(here, key=KEY), Link(far_end, 1, 1, key=theirs)
    link.listen(lambda message, arrival: got.append(message.get_type()))
    return link, peer, got


def hear(link):
    link.pump(lambda: 0.0)


def keyed(tmp_path, data: bytes, mode=0o600):
    path = tmp_path / "key"
    path.write_bytes(data)
    path.chmod(mode)
    return path


def test_a_key_is_raw_hexadecimal_or_a_phrase(tmp_path):
    assert read_key(keyed(tmp_path, KEY)) == KEY
    assert read_key(keyed(tmp_path, KEY.hex().encode() + b"\n")) == KEY
    assert (
        read_key(keyed(tmp_path, b"correct horse battery\n"))
        == hashlib.sha256(b"correct horse battery").digest()
    )


@mark.parametrize(
    ("data", "mode", "text"),
    [(b"short", 0o600, "5 characters; expected 32 bytes"), (KEY, 0o644, "chmod 600")],
)
def test_files_that_are_no_key(tmp_path, data, mode, text):
    with raises(LinkError, match=text):
        read_key(keyed(tmp_path, data, mode))
    with raises(LinkError, match="No such file"):
        read_key(tmp_path / "none")


def test_pymavlinks_check_takes_what_we_send():
    theirs = mav.MAVLink(None, 1, 1)
    theirs.signing.secret_key = KEY
    ours = Signed(KEY, 245, 191)
    for _ in range(5):
        assert theirs.decode(bytearray(WORD.pack(ours))).get_signed()
    assert theirs.signing.goodsig_count == 5


@mark.parametrize("theirs", [None, bytes(32)])
def test_unsigned_and_wrongly_signed_messages_are_refused_and_counted(theirs):
    link, peer, got = pair(theirs=theirs)
    for _ in range(4):
        peer.send(WORD)
    hear(link)
    assert got == []
    (row,) = link.roster.summary()["refused_most"]
    assert (row["count"], row["what"]) == (
        4,
        "message of system 1, component 1 from 127.0.0.1:1: no valid signature",
    )


def test_a_forged_time_does_not_shut_the_true_sender_out():
    """pymavlink notes the time of a message whose signature is wrong."""
    link, peer, got = pair()
    peer.send(WORD)
    data = bytearray(link.port.inbox[0])
    data[-12:-6] = (2**48 - 1).to_bytes(6, "little")
    link.port.inbox.appendleft(bytes(data))
    hear(link)
    peer.send(WORD)
    hear(link)
    assert got == ["HEARTBEAT"] * 2


@mark.parametrize(("behind", "taken"), [(LAG_LIMIT - 100_000, True), (LAG_LIMIT + 100_000, False)])
def test_a_new_stream_may_be_a_minute_behind(behind, taken):
    link, peer, got = pair()
    peer._mav.signing.timestamp = stamp_now() - behind
    peer._mav.touch = lambda: None
    peer.send(WORD)
    hear(link)
    assert bool(got) == taken
    assert abs(stamp_now() / 1e5 + EPOCH - time.time()) < 1.0
