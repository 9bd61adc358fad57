"""The same streams of poses to ``hil check`` and to a run: the check fails the bad ones for the
reason that is true, and a run hovers on those alone that the check passes.
"""

from pytest import mark

from hil.control.loop import Loop
from hil.control.tick.runner import Runner
from hil.links.backends.base import DryRun
from hil.links.clock import ManualClock
from hil.params import HilParams
from tests.commands import run_command
from tests.configs import load_run
from tests.hil_flight import Nobody, simple_policy
from tests.pose_streams import SECONDS, STREAMS, Sent

SETTINGS = [
    "policy=state",
    "observe=false",
    'source.senders=[{ body = "vehicle", message = "ODOMETRY", system = 1, component = 1 }, '
    '{ body = "payload", message = "ODOMETRY", system = 1, component = 25 }]',
]


def loaded() -> HilParams:
    return load_run("dry_run", SETTINGS)


@mark.parametrize("name", STREAMS)
def test_the_check_fails_what_no_run_hovers_on(name, monkeypatch, capsys):
    stream, params = STREAMS[name], loaded()
    sent = Sent(params, stream)
    monkeypatch.setattr(
        "hil.check.open_source", lambda *args: (sent, None, ManualClock(sent.start))
    )
    status = run_command(f"hil check --seconds {SECONDS - 0.1}", sets=SETTINGS)
    out = capsys.readouterr().out
    fails = [line for line in out.splitlines() if line.startswith("FAIL")]
    assert status == bool(stream.says), out
    assert any(stream.says in line for line in fails) if stream.says else not fails, out

    states, runner = [], Runner(params, simple_policy(), DryRun())
    source, clock = Sent(params, stream), ManualClock(0.0)
    loop = Loop(runner, source, clock, Nobody(), tell=lambda d: states.append((d.state, d.waits)))
    loop.fly(SECONDS)
    hovers = "ready" in [state for state, _ in states]
    assert hovers == (not stream.says), states
    assert not stream.says or any(waits for _, waits in states), "a run that waits says for what"


def test_the_check_fails_where_a_run_would_wait_for_the_autopilot(monkeypatch, printed):
    sent = Sent(loaded(), STREAMS["100 Hz"])
    opened = sent, sent.links[0], ManualClock(sent.start)
    monkeypatch.setattr("hil.check.open_source", lambda *args: opened)
    settings = [*SETTINGS, "backend=ardupilot"]
    assert "FAIL  autopilot not ready (no heartbeat)" in printed(
        f"hil check --seconds {SECONDS - 0.1}", sets=settings, status=1
    )
