"""The ArduPilot back-end against the fake autopilot: what is followed, what is answered, what is
never sent.
"""

from pytest import raises

from hil.errors import RunError
from hil.links.backends.ardupilot import GUIDED, LAND_MODE, ArduPilot
from hil.links.mavlink_link import Link
from hil.rehearsal.fake import VEHICLE_ID, FakeOptions
from hil.rehearsal.fake_ardupilot import FakeArduPilot
from hil.rehearsal.fake_mocap import FakeMocapParams
from hil.rehearsal.process import load_plant
from tests.configs import load_run
from tests.hil_flight import AT_ONCE
from tests.level import LevelPlant
from tests.loopback.wire import pipe, throw

PARAMS = load_run("fake", ["ardupilot.audit=false"]).ardupilot


def pair(answer="accepted", **options):
    here, there = pipe()
    fake = FakeArduPilot(
        LevelPlant(),
        Link(there, *VEHICLE_ID),
        FakeMocapParams(loss=0.0),
        0,
        FakeOptions(answer=answer, **options),
    )
    link = Link(here)
    return ArduPilot(link, PARAMS), link, fake


def turn(backend, link, fake, periods=1):
    for _ in range(periods):
        fake.step()
        link.pump(lambda: fake.plant.time)
        backend.service(fake.plant.time)


def test_connected_by_its_heartbeat_until_it_falls_silent():
    backend, link, fake = pair()
    assert backend.status(0.0).note == "no heartbeat"
    turn(backend, link, fake)
    assert backend.status(0.0).connected
    assert backend.status(3.1).note.startswith("no heartbeat for 3.1")
    fake.mode = 5
    turn(backend, link, fake, 250)
    assert "in mode 5; expected GUIDED" in backend.status(fake.plant.time).note


def test_an_abort_asks_for_the_mode_until_it_is_there():
    backend, link, fake = pair()
    turn(backend, link, fake)
    assert fake.mode == GUIDED
    sent = link.sent
    for _ in range(50):
        backend.abort(fake.plant.time)
        turn(backend, link, fake)
    assert fake.mode == LAND_MODE
    assert link.sent - sent <= 6, "asked at most every 0.1 s"


def test_a_payload_that_stayed_on_is_seen_in_its_own_poses():
    plant = LevelPlant()
    summary, _, told = throw(plant, answer="stuck", loaded=AT_ONCE, seconds=5.0)
    assert (summary["latches"], summary["landings"], summary["stuck"]) == (1, [], 1)
    assert plant.released is None
    assert ("abort", "the release was refused or not answered") in [
        (d.state, d.reason) for d in told
    ]


def test_plants_that_are_none():
    for target in (
        "nowhere:make",
        "visthrow.throws.wire_plant:none",
        "visthrow.throws.wire_plant",
        "",
        "os:system",
        "math:pi",
    ):
        with raises(RunError, match="expected module:function"):
            load_plant(target, "state", 0)
