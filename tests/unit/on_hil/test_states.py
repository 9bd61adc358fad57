"""The state machine alone: from each state, what each input leads to and how soon."""

from dataclasses import replace

from pytest import mark

from hil.control.state_machine import Inputs, Machine, State, StateParams
from hil.poses.gate import ABORT, HOLD, OK, WARN

TICK = 0.125  # [s]; a power of two, so that times are exact
PARAMS = StateParams(4.0, 5.0, 0.5, 6.0, 3.0, 1.0, 0.5, 2.0, 3.0, 4.0, 1.5)
GOOD = Inputs(OK, OK, calm=True)
WAYS = {
    "idle": [],
    "check": ["check"],
    "ready": ["check", "ready"],
    "armed": ["check", "ready", "armed"],
    "throw": ["check", "ready", "armed", "throw"],
    "recover": ["check", "ready", "armed", "throw", "recover"],
}
WORDS = {"armed": {"arm": True}, "recover": {"separated": True, "released": True}}
"""What leads into a state, beside good inputs."""


class Walk:
    """A machine that has just come to a state, at ``now``."""

    def __init__(self, state: str, throws: int = 1):
        self.machine, self.now = Machine(PARAMS, throws), 0.0
        self.machine.step(0.0, replace(GOOD, vehicle=HOLD))
        for following in WAYS[state]:
            given = replace(GOOD, **WORDS.get(following, {}))
            while self.machine.state != following:
                self.now += TICK
                self.machine.step(self.now, given)

    def after(self, seconds: float, **given) -> str:
        """State after an input that lasts so long."""
        for _ in range(round(seconds / TICK)):
            self.now += TICK
            self.machine.step(self.now, replace(GOOD, **given))
        return self.machine.state


STAYS = {
    "idle": [{"vehicle": HOLD}, {"payload": HOLD}, {"connected": False}],
    "check": [
        {"vehicle": HOLD},
        {"payload": HOLD},
        {"connected": False},
        {"failed_checks": ("tilted",)},
        {"streams": ("rare",)},
    ],
    "ready": [
        {},
        {"arm": True, "following": False},
        {"arm": True, "recording": False},
        {"arm": True, "failed_checks": ("tilted",)},
        {"arm": True, "payload": HOLD},
    ],
    "armed": [{"calm": False}, {"failed_checks": ("tilted",)}],
    "throw": [{}, {"released": True, "payload": HOLD}, {"released": True, "lost": True}],
    "recover": [{"calm": False}],
}


@mark.parametrize(
    ("state", "given"), [(state, given) for state, row in STAYS.items() for given in row]
)
def test_what_keeps_a_state_keeps_it_until_its_time_is_over(state, given):
    walk = Walk(state)
    time = getattr(PARAMS, state)
    assert walk.after(time, **given) == state
    late = {"idle": "abort", "check": "abort", "ready": "land", "armed": "ready", "recover": "land"}
    late["throw"] = "throw" if given.get("released") else "recover"  # it cannot be taken back
    assert walk.after(TICK, **given) == late[state]


@mark.parametrize(
    ("state", "given", "follows", "seconds"),
    [
        ("idle", {}, "check", TICK),
        ("idle", {"vehicle": WARN, "payload": WARN}, "check", TICK),
        ("check", {}, "ready", 0.625),
        ("ready", {"arm": True}, "armed", TICK),
        ("ready", {"land": True}, "land", TICK),
        ("armed", {}, "throw", 1.0),
        ("armed", {"land": True}, "land", TICK),
        ("armed", {"vehicle": HOLD}, "ready", TICK),
        ("armed", {"payload": HOLD}, "ready", TICK),
        ("armed", {"recording": False}, "ready", TICK),
        ("armed", {"following": False}, "ready", TICK),
        ("throw", {"separated": True}, "recover", TICK),
        ("throw", {"vehicle": HOLD}, "recover", TICK),
        ("throw", {"payload": HOLD}, "recover", TICK),
        ("throw", {"lost": True}, "recover", TICK),
        ("throw", {"astray": True}, "recover", TICK),
        ("recover", {"released": True}, "land", 0.625),
        ("recover", {"land": True, "calm": False}, "land", TICK),
        ("recover", {"released": True, "fence": "x"}, "land", TICK),
    ],
)
def test_what_leads_on_and_when(state, given, follows, seconds):
    walk = Walk(state)
    assert walk.after(seconds - TICK, **given) == state
    assert walk.after(TICK, **given) == follows


def test_quiet_must_last_without_a_break():
    walk = Walk("armed")
    walk.after(1.0, calm=False)
    assert [walk.after(0.375), walk.after(TICK, calm=False)] == ["armed", "armed"]
    assert [walk.after(0.5), walk.after(TICK)] == ["armed", "throw"]


@mark.parametrize("throws", [1, 2, 3])
def test_it_lands_after_the_last_throw(throws):
    walk = Walk("recover", throws)
    for count in range(1, throws):
        assert walk.after(0.625) == "ready"
        assert walk.machine.throws == count
        walk.after(TICK, arm=True)
        assert walk.after(1.0) == "throw"
        walk.after(TICK, separated=True, released=True)
    assert walk.after(0.625) == "land"
    assert (walk.machine.throws, walk.machine.cancelled) == (throws, 0)
    assert walk.after(TICK, grounded=True) == "done"


@mark.parametrize("state", WAYS)
@mark.parametrize(
    "given",
    [
        {"abort": True},
        {"failure": "broken"},
        {"vehicle": ABORT},
        {"fence": "x"},
        {"connected": False},
        {"disagrees": "it turns the other way"},
    ],
    ids=lambda given: next(iter(given)),
)
def test_what_aborts_and_where(state, given):
    word = next(iter(given))
    always = word in ("abort", "failure")
    flying = state not in ("idle", "check") and word != "disagrees"
    before = state in ("ready", "armed") and word == "disagrees"
    walk = Walk(state)
    aborts = always or flying or before
    assert (walk.after(TICK, **given) == "abort") == aborts
    if aborts:
        assert walk.machine.aborted
        assert walk.machine.handed_back == before
        # A vehicle that never was ours needs no descent.
        seconds = PARAMS.abort if state not in ("idle", "check") else 0.0
        assert walk.after(seconds) == "abort"
        assert walk.after(TICK) == "done"


def test_a_throw_that_ends_without_a_release_is_counted():
    walk = Walk("throw")
    walk.after(TICK, payload=HOLD)
    assert walk.machine.cancelled == 1
    assert walk.machine.state == State.RECOVER
