"""Faults of motion capture, injected over the wire: the runner's reaction, and its delay.

In lock step the whole chain runs on MAVLink bytes, on the plant's clock, the same on every machine.
"""

from pytest import approx, mark

from tests.hil_flight import AT_ONCE, NEVER, AutoOperator
from tests.level import LevelPlant
from tests.loopback.test_autopilot_faults import when
from tests.loopback.wire import QUICK, cut, peers
from tests.mocap_faults import FAULTS

START = 1.2
"""When the fault begins [s]: in a throw that the policy never releases."""

ODOMETRY = (
    (
        'source.senders=[{ body = "vehicle", message = "ODOMETRY", system = 1, component = 1 }, '
        '{ body = "payload", message = "ODOMETRY", system = 1, component = 25 }]'
    ),
)

HOLD, ABORT, TICK = 0.10, 0.25, 0.02
"""Content ages that end a throw and a run, and the runner's period [s]."""

ROOM = 2 * TICK
"""From the last good pose's measurement to the fault, by its latency, and to the next tick [s]."""

ENDS = {"stop", "repeat", "swap", "jump", "order", "zero-quaternion", "nan-quaternion", "reset"}
"""Faults after which no pose is to be trusted any more."""

FLOWN_THROUGH = {"none", "clock-forth", "clock-back", "shuffle", "double"}


def run_spoiled(name: str):
    """A run in which a fault happens in mid throw: runner, fake, and the first decision of each
    state.
    """
    more = ODOMETRY if name == "reset" else ()
    plant, decisions = LevelPlant(), []
    runner, source, clock, fake = peers(
        plant,
        overrides=(*QUICK, *more),
        loaded=NEVER,
        mocap_fault=(name, START),
        pose_message="ODOMETRY" if more else "ATT_POS_MOCAP",
    )
    cut(runner, source, clock, AutoOperator(), None, START + 0.7, decisions.append)
    return runner, fake, [(d.state, d.reason, d.time) for d in decisions]


@mark.parametrize("name", sorted(FAULTS))
def test_a_fault_in_mid_throw(name):
    runner, fake, decisions = run_spoiled(name)
    assert when(decisions, "throw") < START - 0.2, "the throw goes on when the fault begins"
    after = [(state, reason) for state, reason, time in decisions if time > START]
    if name in ENDS:
        assert after[0] == ("recover", "stale poses")
        assert when(decisions, "recover") == approx(START + HOLD, abs=ROOM)
        assert after[1][0] == "abort"
        assert "no new pose of the vehicle" in after[1][1]
        assert when(decisions, "abort") == approx(START + ABORT, abs=ROOM)
    elif name == "payload-lost":
        assert after[0] == ("recover", "stale poses")
        assert when(decisions, "recover") == approx(START + HOLD, abs=ROOM)
        assert "abort" not in [state for state, _ in after]
    elif name == "rare":
        assert after[0][0] == "recover"
        assert when(decisions, "recover") <= START + 0.2 + HOLD + ROOM
        assert "throw" not in [state for state, _ in after]
    else:
        assert name in FLOWN_THROUGH
        assert after == [], "the throw goes on"
    assert fake.witness.breaches == []
    assert fake.witness.releases == 0
    assert fake.witness.commands > 30
    assert not runner.errors


@mark.parametrize("name", ["swap", "order", "jump", "shuffle", "clock-forth"])
def test_a_fault_as_the_policy_asks_for_the_release(name):
    """The policy requests the release from the first tick of the throw on; the fault begins with
    the check: nothing is released unless the poses passed all checks, and then once.
    """
    plant = LevelPlant()
    runner, source, clock, fake = peers(
        plant, overrides=(*QUICK, "states.check=1.0"), loaded=AT_ONCE, mocap_fault=(name, 0.0)
    )
    cut(runner, source, clock, AutoOperator(), None, 3.0, lambda decision: None)
    assert fake.witness.breaches == []
    assert fake.witness.releases == (1 if name in FLOWN_THROUGH else 0), runner.machine.reason
    assert runner.latch.count == fake.witness.releases
    if name not in FLOWN_THROUGH and name != "jump":
        assert fake.witness.commands == 0, "what fails the checks is never flown"
