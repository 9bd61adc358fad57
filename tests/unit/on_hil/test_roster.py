"""Parties of a link: ids, type of autopilot, addresses that are fixed in flight; refusals are
counted and reported.
"""

from pytest import mark, raises

from hil.errors import LinkError
from hil.links.pymav import mav
from hil.links.roster import MOST_KEPT, SILENT, SIMULATED, Party, Roster, check_allowed
from tests.loopback.wire import pass_wire
from tests.unit.on_hil.test_sources import mocap, odometry

AUTOPILOT = Party("autopilot", 1, 1, autopilot=mav.MAV_AUTOPILOT_PX4)
VEHICLE = Party("vehicle", 1, 1, frozenset({"ATT_POS_MOCAP"}))
BALL = Party("payload", 42, 0, frozenset({"ODOMETRY"}))
A, B, C = ("127.0.0.1", 1001), ("127.0.0.1", 1002), ("10.0.0.9", 14550)


def beat(autopilot=mav.MAV_AUTOPILOT_PX4, **ids):
    return pass_wire(mav.MAVLink_heartbeat_message(2, autopilot, 0, 0, 0, 3), **ids)


def pose(**ids):
    return pass_wire(mocap(), **ids)


def roster(*parties, **more):
    messages = []
    return Roster(parties or (AUTOPILOT, VEHICLE, BALL), tell=messages.append, **more), messages


def test_poses_and_autopilot_of_the_same_ids_come_from_two_senders():
    """A bridge of the motion capture that uses the vehicle's ids, beside the vehicle."""
    who, messages = roster()
    assert who.admit(pose(), A, 0.0)
    assert who.admit(beat(), B, 0.1)
    assert who.admit(pass_wire(odometry(), system=42, component=7), A, 0.2)
    assert who.at == {"vehicle": A, "autopilot": B, "payload": A}
    assert (who.refused, messages) == (0, [])
    assert who.addresses(mav.MAVLink_command_long_message(1, 1, 0, 0, 0, 0, 0, 0, 0, 0, 0)) == (B,)
    assert set(who.addresses(mav.MAVLink_timesync_message(0, 1))) == {A, B}
    sync = pass_wire(mav.MAVLink_timesync_message(5, 6))
    assert who.admit(sync, A, 0.3), "either clock of system 1"
    assert who.admit(sync, B, 0.3)
    assert not who.admit(sync, C, 0.3)


def test_an_autopilot_is_heard_from_its_first_right_heartbeat_on():
    who, messages = roster(AUTOPILOT)
    other = pass_wire(mav.MAVLink_sys_status_message(0, 0, 0, 0, 12000, 0, 0, 0, 0, 0, 0, 0, 0))
    assert not who.admit(other, A, 0.0)
    assert not who.admit(beat(mav.MAV_AUTOPILOT_ARDUPILOTMEGA), A, 0.1)
    assert not who.at
    assert who.admit(beat(), A, 0.2)
    assert who.admit(other, A, 0.3)
    assert not who.admit(beat(mav.MAV_AUTOPILOT_ARDUPILOTMEGA), A, 0.4), (
        "at its own address as well"
    )
    assert who.refused == 2, "what came too early is of no stranger"
    assert messages == [
        (
            "refused: HEARTBEAT of system 1, component 1 from 127.0.0.1:1001: it is a"
            " ARDUPILOTMEGA, expected is a PX4"
        ),
    ]


def test_a_stranger_is_refused_counted_and_reported_once():
    who, messages = roster()
    for i in range(50):
        assert not who.admit(pose(system=9, component=9), C, 0.01 * i)
    (line,) = messages
    assert line.startswith(
        "refused: ATT_POS_MOCAP of system 9, component 9 from 10.0.0.9:14550: nobody of this run,"
        " which expects"
    )
    assert "vehicle as 1/1 (ATT_POS_MOCAP)" in line
    assert who.summary()["refused_most"][0]["count"] == who.refused == 50


def test_messages_outside_of_a_partys_role_are_neither_taken_nor_reported():
    who, messages = roster(VEHICLE)
    assert who.admit(pose(), A, 0.0)
    assert not who.admit(beat(), A, 0.1)
    assert (who.refused, messages) == (0, [])
    assert not who.admit(beat(), B, 0.1)
    assert who.refused == 1


def test_on_the_ground_a_party_that_fell_silent_comes_back_from_another_address():
    who, messages = roster()
    back = []
    who.moved.append(back.append)
    assert who.admit(beat(), A, 0.0)
    assert not who.admit(beat(), B, SILENT - 0.1), "two at once: the first one stays"
    assert who.admit(beat(), A, SILENT)
    assert not who.admit(beat(), B, 2.0 * SILENT - 0.1)
    assert who.admit(beat(), B, 2.0 * SILENT + 0.1)
    assert (who.at["autopilot"], back, messages[-1]) == (
        B,
        [AUTOPILOT],
        "the autopilot speaks from 127.0.0.1:1002 now",
    )
    assert not who.admit(beat(), A, 2.0 * SILENT + 0.2)


def test_in_flight_no_address_changes():
    who, _ = roster()
    assert who.admit(beat(), A, 0.0)
    assert who.admit(pose(), A, 0.0)
    who.flying = True
    assert not who.admit(beat(), B, 100.0)
    assert not who.admit(pose(), B, 100.0)
    assert who.shuts_out(B), "unread"
    assert not who.shuts_out(A)
    assert not who.shuts_out(None), "a stream has one peer"
    who.flying = False
    assert not who.shuts_out(B)
    assert who.admit(beat(), B, 101.0)


def test_only_those_on_the_list_are_looked_at():
    who, messages = roster(allow=("10.0.0.9", "127.0.0.1:1002"))
    assert [who.shuts_out(address) for address in (A, B, C, ("10.0.0.9", 5))] == [
        True,
        False,
        False,
        False,
    ]
    assert messages == ["refused: datagram from 127.0.0.1:1001: not on link.allow"]


@mark.parametrize("text", ["example.org", "10.0.0.300", "10.0.0.9:x", "", "10.0.0.9:14550:1"])
def test_a_list_of_allowed_senders_holds_addresses(text):
    with raises(LinkError, match=r"link\.allow .*; expected a numeric address"):
        check_allowed((text,))


def test_no_flood_fills_the_memory():
    who, messages = roster()
    for i in range(20_000):
        who.admit(pose(system=9, component=i % 256), ("10.0.0.9", 1 + i), 0.0)
    assert len(who.received) <= MOST_KEPT + 1
    assert who.refused == 20_000
    assert len(messages) <= 20


def test_a_fake_says_that_it_is_one():
    who, _ = roster()
    word = pass_wire(mav.MAVLink_named_value_int_message(0, SIMULATED.encode(), 1))
    assert not who.admit(word, A, 0.0)
    assert not who.simulated
    who.admit(pose(), A, 0.0)
    assert not who.admit(word, B, 0.0), "no party may send it for another one"
    assert not who.simulated
    who.admit(word, A, 0.1)
    assert who.simulated
    assert who.summary()["simulated"]
