"""The parameter audit: values are requested until the vehicle answers, judged, and written only
with the operator's option; and the book-keeping of the release.
"""

from pytest import approx

from hil.links.backends.audit import (
    GIVE_UP,
    GIVE_UP_OPTIONAL,
    Audit,
    Rule,
)
from hil.links.backends.base import ACCEPTED, FAILED, IDLE, Release

RULES = (
    Rule("GUID_OPTIONS", "thrust", mask=8, write=True),
    Rule("ATC_ANGLE_BOOST", "tilt", (0.0,), write=True),
    Rule(
        "GUID_TIMEOUT",
        "silence",
        above=0.0,
        maximum=0.5,
        expected="above 0, at most 0.5",
        write=True,
    ),
    Rule("FIXED", "cannot be written", (7.0,)),
)
GOOD = {"GUID_OPTIONS": 13.0, "ATC_ANGLE_BOOST": 0.0, "GUID_TIMEOUT": 0.5, "FIXED": 7.0}


def audit(values, write=False):
    """An audit of a vehicle with these parameters: the audit, its requests and writes, the tables
    shown.
    """
    values, requests, written, tables = dict(values), [], [], []
    box = []

    def ask(name):
        requests.append(name)
        if name in values:
            box[0].feed(name, values[name])

    def put(name, value):
        written.append((name, value))
        values[name] = value

    box.append(Audit(RULES, ask, put if write else None, tables.append))
    now = 0.0
    while not box[0].done:
        box[0].service(now)
        now += 0.02
    return box[0], requests, written, tables, now


def test_a_parameter_that_does_not_come_is_a_mismatch():
    values = {k: v for k, v in GOOD.items() if k != "ATC_ANGLE_BOOST"}
    checked, requests, _, tables, now = audit(values)
    assert checked.problems == ["ATC_ANGLE_BOOST did not come; expected 0"]
    assert GIVE_UP < now < GIVE_UP + 0.1
    assert 20 <= requests.count("ATC_ANGLE_BOOST") <= 27, "requested repeatedly"
    assert "no answer" in tables[0]


def test_writing_keeps_other_bits_and_is_read_back():
    checked, _, written, tables, _ = audit(
        {**GOOD, "GUID_OPTIONS": 5.0, "GUID_TIMEOUT": 3.0}, write=True
    )
    assert (checked.problems, sorted(written)) == (
        [],
        [("GUID_OPTIONS", 13), ("GUID_TIMEOUT", 0.5)],
    )
    assert tables[0].count("(written)") == 2


def test_what_cannot_be_written_stays_wrong():
    checked, _, written, _, _ = audit({**GOOD, "FIXED": float("nan")}, write=True)
    assert (checked.problems, written) == (["FIXED is nan; expected 7"], [])


def test_a_timeout_of_zero_is_below_its_range():
    checked, *_ = audit({**GOOD, "GUID_TIMEOUT": 0.0})
    assert checked.problems == ["GUID_TIMEOUT is 0; expected above 0, at most 0.5"]


def test_a_value_that_the_vehicle_does_not_take_is_written_once():
    sent = []
    stubborn = Audit(
        RULES[1:2], lambda name: stubborn.feed(name, 1.0), lambda name, value: sent.append(value)
    )
    for i in range(400):
        stubborn.service(0.02 * i)
    assert (sent, stubborn.problems) == ([0.0], ["ATC_ANGLE_BOOST is 1; expected 0"])


def test_an_optional_parameter_that_nobody_answers_is_soon_given_up():
    audited = Audit((Rule("OLD", "", (1.0,), optional=True),))
    audited.service(0.0)
    audited.service(GIVE_UP_OPTIONAL + 0.1)
    assert (audited.done, audited.problems) == (True, [])


def sends(release, until, start=0.0):
    """Times at which the release is to be sent."""
    out, now = [], start
    while now < until:
        if release.due(now):
            out.append(round(now, 3))
        now += 0.005
    return out


def test_a_release_is_sent_at_its_time_and_repeated_until_it_is_answered():
    release = Release(0.5)
    release.start(0.1)
    release.start(0.2)
    assert sends(release, 0.2) == approx([0.1, 0.14, 0.18], abs=0.006)
    release.answer(True)
    assert (release.state, sends(release, 2.0, 0.2)) == (ACCEPTED, [])
    release.start(3.0)
    assert sends(release, 4.0, 3.0) == [], "never twice"


def test_an_output_that_stood_open_all_along_has_not_moved():
    """The wrong end in the config, or a mechanism left open: a jammed one would pass otherwise."""
    release = Release(0.5, read_back=True)
    release.output(True)
    release.start(0.0)
    release.due(0.0)
    release.answer(True)
    release.output(True)
    sends(release, 0.6)
    assert (release.state, release.note) == (
        FAILED,
        "accepted, but the output was not seen closed before within 0.5 s",
    )


def test_what_was_stopped_before_its_time_never_happened():
    release = Release(0.5)
    release.start(0.1)
    release.stop()
    assert (release.state, sends(release, 1.0)) == (IDLE, [])
    release.start(2.0)
    release.due(2.0)
    release.stop()
    assert sends(release, 2.4, 2.01) == [], "one that was sent is not repeated"
    release.answer(True)
    assert release.state == ACCEPTED, "but its answer counts"
    release.reset()
    release.answer(False, "late")
    assert release.state == IDLE, "an answer to nothing is none"
