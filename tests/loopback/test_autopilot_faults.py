"""Faults on the autopilot's side, over the wire: the runner's reaction and its delay; the vehicle's
behaviour without it.

In every one the fake watches that no command arrives that is not finite or within limits, and that
the release comes once at most, from an armed vehicle inside its fence."""

import errno
import time

from pytest import approx, mark

from hil.control.recording.record import RunRecorder
from tests.fakes.fake_px4 import HOLD
from tests.hil_flight import AT_ONCE, NEVER, AutoOperator
from tests.level import LevelPlant
from tests.loopback.wire import AUTOPILOTS, QUICK, cut, peers

START = 2.2
"""When the fault begins [s]: in a throw that the policy never releases."""

TICK = 0.02
BEAT = {"ardupilot": 1.0, "px4": 1.0, "betaflight": 0.1}
"""Between two signs of life of the autopilot [s]."""


def run(
    kind,
    seconds,
    loaded=NEVER,
    watch=None,
    operator=None,
    overrides=(),
    plant=None,
    recorder=None,
    **options,
):
    """A run in lock step; ``watch(now, runner, fake)`` is called before every tick. Fake, summary,
    changes of state.
    """
    made = peers(
        plant or LevelPlant(), kind=kind, loaded=loaded, overrides=(*QUICK, *overrides), **options
    )
    runner, source, clock, fake = made
    operator = operator or AutoOperator()
    decisions, tick = [], runner.tick

    def ticked(now, *args, **kwargs):
        if watch is not None:
            watch(now, runner, fake)
        return tick(now, *args, **kwargs)

    runner.tick = ticked
    summary = cut(runner, source, clock, operator, recorder, seconds, decisions.append)
    assert fake.witness.breaches == []
    return fake, summary, [(d.state, d.reason, d.time) for d in decisions]


def when(decisions, state: str) -> float:
    return next(time for name, _, time in decisions if name == state)


def reason(decisions, state: str) -> str:
    return next(text for name, text, _ in decisions if name == state)


GONE = "the autopilot is silent, disarmed or in another mode"


@mark.parametrize("kind", AUTOPILOTS)
def test_silent(kind):
    """Abort after the heartbeat's time-out, counted from the last sign of life."""
    limit = 0.5 if kind == "betaflight" else 1.5
    override = () if kind == "betaflight" else (f"{kind}.heartbeat_timeout=1.5",)
    _, _, decisions = run(kind, START + 2.2, silent_after=START, overrides=override)
    assert reason(decisions, "abort").startswith(GONE)
    assert START + limit - BEAT[kind] - TICK <= when(decisions, "abort") <= START + limit + 2 * TICK


@mark.parametrize("kind", AUTOPILOTS)
def test_the_pilot_takes_over(kind):
    """Abort at the next sign of life; from then on no command is sent and no mode requested."""

    def watch(now, runner, fake):
        if now >= START + 0.3:
            commands.add(fake.witness.commands)
            modes.add(getattr(fake, "mode", None))

    commands, modes = set(), set()
    fake, _, decisions = run(kind, START + 1.0, watch=watch, taken_after=START)
    assert reason(decisions, "abort").startswith(GONE)
    assert when(decisions, "abort") <= START + BEAT["betaflight"] + 3 * TICK
    assert (len(commands), len(modes)) == (1, 1), "silent: the pilot has it"
    assert fake.taken


@mark.parametrize("before", [0.0, 0.02, 0.06])
def test_a_pilots_hold_at_the_end_of_a_throw_stands(before):
    """The runner requests Hold a moment later, before a heartbeat has reported the pilot's: it does
    not take the mode for its own, and requests no Land.
    """
    taken = []

    def watch(now, runner, fake):
        separation = runner.latch.at and runner.latch.at + runner.latch.lag
        if separation and now >= separation - before - 1e-3 and not taken:
            taken.append(now)
            fake.enter(HOLD)

    fake, _, decisions = run("px4", START + 2.0, loaded=AT_ONCE, watch=watch)
    assert decisions[-1][0] == "done"
    assert reason(decisions, "abort").startswith(GONE)
    modes = [text for time, text in fake.events if time >= taken[0] and text.startswith("mode")]
    assert modes == ["mode 4.3"]


@mark.parametrize("kind", AUTOPILOTS)
def test_disarmed_and_not_ours_to_arm(kind):
    fake, _, decisions = run(kind, 4.0, armed=False, overrides=("states.idle=1.5",))
    assert reason(decisions, "abort") == "autopilot not ready (disarmed), for 1.5 s"
    assert fake.witness.commands == 0


@mark.parametrize(
    ("kind", "override"), [("ardupilot", "ardupilot.arm=true"), ("px4", "px4.arm=true")]
)
def test_refuses_arming(kind, override):
    """It refuses to arm in READY; that ends the run, with the autopilot's message."""
    notes = []

    def listen(now, runner, fake):
        notes.append(runner.backend.status(now).note)

    fake, _, decisions = run(
        kind, 5.0, armed=False, arming=False, overrides=(override,), watch=listen
    )
    assert reason(decisions, "abort").startswith(GONE)
    assert when(decisions, "abort") - when(decisions, "ready") < 1.6
    assert any("arming refused with result 4: Arm: battery below minimum" in note for note in notes)
    assert not fake.armed
    assert fake.witness.releases == 0


@mark.parametrize("kind", ["ardupilot", "px4"])
def test_arms_on_the_named_port(kind):
    fake, _, decisions = run(kind, 4.0, armed=False, overrides=(f"{kind}.arm=true",))
    assert "throw" in [state for state, _, _ in decisions]
    assert "armed" in [text for _, text in fake.events]


def test_betaflight_refuses_arming():
    fake, _, decisions = run(
        "betaflight",
        4.0,
        armed=False,
        arming=False,
        all_channels=True,
        overrides=("betaflight.arm_channel=1", "states.idle=1.5"),
    )
    assert (
        reason(decisions, "abort")
        == "autopilot not ready (arming disabled: tilted more than small_angle (flags 0x100)), for"
        " 1.5 s"
    )
    assert not fake.armed


RELEASES = {
    ("ardupilot", "stuck"): 0.5,
    ("betaflight", "stuck"): 0.5,
    ("px4", "in-progress"): 1.5,
    ("ardupilot", "silent"): 0.5,
    ("betaflight", "silent"): 0.5,
    ("px4", "denied"): 0.0,
}
"""By kind and answer: the time after the latch at which the release has failed [s]; "denied" at
once.
"""


@mark.parametrize(("kind", "answer"), RELEASES)
def test_a_release_that_does_not_happen(kind, answer):
    """ACK without movement, IN_PROGRESS for ever, silence, refusal: the run is aborted, and it is
    never sent again. The vehicle is quiet again long before, which does not count while the answer
    is out.
    """
    limit = RELEASES[kind, answer]
    last = []

    def watch(now, runner, fake):
        if fake.witness.releases > len(last):
            last.extend([now] * (fake.witness.releases - len(last)))

    fake, summary, decisions = run(
        kind,
        6.0,
        AT_ONCE,
        watch,
        answer=answer,
        overrides=("px4.release_timeout=1.5",),
    )
    (latch,) = summary["latch_times"]
    assert reason(decisions, "abort") == "the release was refused or not answered"
    assert latch + limit <= when(decisions, "abort") <= latch + limit + 3 * TICK
    assert (summary["latches"], summary["landings"], fake.release_time) == (1, [], None)
    if answer != "silent":
        assert fake.witness.releases == 1
    assert last[-1] <= latch + 0.11 + 2 * TICK, "none is sent after the time of separation"


@mark.parametrize(("kind", "length"), [("ardupilot", 0.15), ("px4", 0.8)])
def test_a_tick_overrun(kind, length):
    """A short one is flown through with ticks counted as missed. A long one finds PX4 out of
    OFFBOARD by its own failsafe: it is not taken back in mid throw.
    """

    def dawdle(now, runner, fake):
        if now >= START and not late:
            late.append(now)
            while fake.plant.time < now + length:
                fake.step()

    late = []
    _, summary, decisions = run(kind, START + 1.2, watch=dawdle)
    assert summary["missed"] == approx(length / TICK, abs=2)
    if kind == "px4":
        assert reason(decisions, "abort").startswith(GONE)
    else:
        assert decisions[-1][0] == "throw"


@mark.parametrize(
    ("kind", "event"),
    [
        ("ardupilot", "levelled: no set-points"),
        ("px4", "left OFFBOARD: no set-points"),
        ("betaflight", "override: the pilot's sticks count again"),
    ],
)
def test_a_runner_that_is_killed_in_mid_throw_leaves_the_vehicle_to_its_failsafe(kind, event):
    """It falls silent between two ticks and never comes back."""
    fake, _, decisions = run(kind, START)
    assert decisions[-1][0] == "throw"
    for _ in range(round(2.5 / fake.plant.period)):
        fake.step()
    assert event in [text for _, text in fake.events]
    assert (fake.witness.breaches, fake.witness.releases) == ([], 0)


@mark.parametrize("full_at", [0.0, START])
def test_the_disk_is_full(tmp_path, full_at):
    """Before the throw nothing is armed.

    In mid-throw it is flown to its end, and reported in the summary.
    """
    params = peers(LevelPlant(), loaded=NEVER, overrides=QUICK)[0].params
    recorder = RunRecorder(tmp_path / "run", params)

    class Full:
        def write(self, text):
            raise OSError(errno.ENOSPC, "No space left on device")

        def flush(self):
            pass

        def close(self):
            pass

    def fill(now, runner, fake):
        if now >= full_at:
            recorder._writer._file = Full()
        # The recorder writes in a thread of its own; lock step does not wait for it.
        patience = time.monotonic() + 10.0
        while now >= full_at + 0.2 and not recorder.failed and time.monotonic() < patience:
            time.sleep(0.01)

    fake, summary, decisions = run("ardupilot", START + 0.5, watch=fill, recorder=recorder)
    states = [state for state, _, _ in decisions]
    if full_at == 0.0:
        assert "throw" not in states
    else:
        assert states[-1] == "throw"
    recorder.close(summary)
    assert "No space left on device" in recorder.failed
    assert fake.witness.releases == 0
