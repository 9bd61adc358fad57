"""The ArduPilot back-end against the fake autopilot: what is followed, what is answered, what is
never sent.
"""

import math

from numpy.testing import assert_allclose
from pytest import approx, mark, raises

from hil.errors import RunError
from hil.links.backends.ardupilot import GUIDED, LAND_MODE, ArduPilot
from hil.links.mavlink_link import Link, attitude_target
from hil.params import HilParams
from hil.rehearsal.fake import VEHICLE_ID, FakeOptions
from hil.rehearsal.fake_ardupilot import FakeArduPilot
from hil.rehearsal.fake_mocap import FakeMocapParams
from hil.rehearsal.process import load_plant
from tests.hil_flight import simple_policy
from tests.level import LevelPlant
from tests.loopback.wire import pipe, throw
from visthrow import config

PARAMS = config.load(HilParams, config.find("hil", "fake"), ["ardupilot.audit=false"]).ardupilot
AT_ONCE = simple_policy((-0.1269, 0.0, 0.0, 0.0, 1.0))


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


def test_units_and_axes_of_the_command():
    backend, link, fake = pair()
    turn(backend, link, fake)
    assert backend.send((7.0, 1.0, 2.0, 3.0), 0.1)
    turn(backend, link, fake)
    assert_allclose(fake.plant.commands[-1], (7.0, 1.0, 2.0, 3.0), rtol=1e-6)
    assert fake.followed == 1


@mark.parametrize(
    "change", [{"type_mask": 132}, {"type_mask": 192}, {"type_mask": 0}, {"target_system": 2}, {}]
)
def test_the_fake_ignores_what_the_real_one_ignores(change):
    _, link, fake = pair()
    message = attitude_target(0.0, (1, 1), 0.5, (0.0, 0.0, 0.0))
    for name, value in change.items():
        setattr(message, name, value)
    if not change:
        fake.mode = LAND_MODE
    link.send(message)
    fake.step()
    assert (fake.followed, fake.ignored) == (0, 1)


def test_silence_levels_the_fake():
    _, link, fake = pair(parameters={"GUID_TIMEOUT": 3.0})
    link.send(attitude_target(0.0, (1, 1), 0.9, (1.0, 0.0, 0.0)))
    for _ in range(590):
        fake.step()
    assert fake.plant.commands[-1][1] == approx(1.0)
    for _ in range(20):
        fake.step()
    assert_allclose(fake.plant.commands[-1], (0.272 * 9.81, 0.0, 0.0, 0.0))


@mark.parametrize(
    ("answer", "state", "sends"),
    [
        ("accepted", "accepted", 1),
        ("in-progress", "failed", 1),
        ("denied", "failed", 1),
        ("silent", "failed", 13),
    ],
)
def test_release_and_its_answers(answer, state, sends):
    backend, link, fake = pair(answer)
    turn(backend, link, fake)
    backend.release(0.1)
    assert backend.due() == 0.1
    backend.release(0.2), backend.release(0.0)
    while fake.plant.time < 0.1:
        assert fake.witness.releases == 0
        turn(backend, link, fake)
    turn(backend, link, fake, 4)
    if answer == "in-progress":
        assert backend.status(fake.plant.time).release == "pending"
    turn(backend, link, fake, 200)
    assert backend.status(fake.plant.time).release == state
    assert fake.witness.releases == approx(sends, abs=1 if sends > 1 else 0)
    assert backend.due() is None


def test_a_release_that_was_stopped_is_not_sent_again():
    backend, link, fake = pair("silent")
    turn(backend, link, fake)
    backend.release(0.0)
    turn(backend, link, fake, 10)
    sent = fake.witness.releases
    backend.stop_release()
    turn(backend, link, fake, 100)
    assert 0 < fake.witness.releases <= sent + 1, "one may be on its way"


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


def test_a_throw_with_a_plain_plant_releases_in_time():
    plant = LevelPlant()
    summary, fake, _ = throw(plant, loaded=AT_ONCE, seconds=5.0)
    assert (fake.witness.releases, summary["latches"], len(summary["landings"])) == (1, 1, 1)
    (latch,) = summary["latch_times"]
    assert abs(plant.released - latch) <= 5e-3, "latch to separation is the trained lag within 5 ms"
    assert summary["missed"] == 0
    down = math.sqrt(2 * (1.333 - 0.383 - 0.04) / 9.81)
    assert summary["landings"][0]["time"] == approx(plant.released + 0.11 + down, abs=6e-3)


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
