"""The operator's terminal: lines, half lines, bytes that are no text, signals; and a console that
never blocks.
"""

import os
import signal
import threading
import time

from pytest import fixture, mark, raises

from hil.control.state_machine import OperatorInput
from hil.errors import RunError
from hil.operator_terminal import ENDING, PAUSING, Console, Terminal
from hil.run_command import require_fake
from tests.configs import load_run


@fixture
def typed(monkeypatch):
    """The writing end of standard input, and a way to make a terminal."""
    read, write = os.pipe()
    stdin = os.fdopen(read, "rb", buffering=0)
    monkeypatch.setattr("sys.stdin", stdin)
    saved = {number: signal.getsignal(number) for number in (*ENDING, *PAUSING)}
    yield write
    for number, handler in saved.items():
        signal.signal(number, handler)
    stdin.close()


def test_lines_are_words_and_half_a_line_holds_nobody_up(typed):
    terminal = Terminal()
    os.write(typed, b"ar")
    assert terminal.words("ready") == OperatorInput()
    os.write(typed, b"m\nLAND \nnonsense\n")
    assert terminal.words("ready") == OperatorInput(arm=True, land=True)
    assert terminal.words("ready") == OperatorInput()
    os.write(typed, b"\xff\xfe\xe9\nabort\n")
    assert terminal.words("ready") == OperatorInput(abort=True), (
        "bytes that are no text raise nothing"
    )
    os.write(typed, b"arm")
    os.close(typed)
    assert terminal.words("ready") == OperatorInput(arm=True), "the last line needs no end"
    assert terminal.words("ready") == OperatorInput()


@mark.parametrize("number", ENDING)
def test_signals_that_would_end_the_process_say_abort(typed, number):
    terminal = Terminal()
    os.kill(os.getpid(), number)
    words = terminal.words("throw")
    assert words.abort
    assert signal.Signals(number).name in words.why or "Ctrl-C" in words.why
    assert terminal.words("abort") == words, "it stays said"
    if number != signal.SIGINT:
        os.kill(os.getpid(), number)  # systemd repeats it; nothing raises
        assert terminal.words("abort") == words


def test_only_a_second_ctrl_c_raises(typed):
    terminal = Terminal()
    os.kill(os.getpid(), signal.SIGTERM)
    os.kill(os.getpid(), signal.SIGINT)
    assert terminal.words("throw").abort
    with raises(KeyboardInterrupt):
        terminal._handle_signal(signal.SIGINT, None)


@mark.parametrize("number", PAUSING)
def test_ctrl_z_does_not_stop_it_in_mid_flight(typed, number):
    Terminal()
    assert signal.getsignal(number) is signal.SIG_IGN


def test_auto_arm_is_for_what_says_that_it_is_simulated(typed):
    messages, simulated = [], []
    terminal = Terminal(True, lambda: bool(simulated), messages.append)
    assert not terminal.words("ready").arm
    assert not terminal.words("ready").arm
    assert len(messages) == 1
    assert "does not say that it is simulated" in messages[0]
    simulated.append(1)
    assert not terminal.words("check").arm
    assert terminal.words("ready").arm
    assert not Terminal(False, lambda: True).words("ready").arm


@mark.parametrize(
    ("base", "override"),
    [
        ("ardupilot", "throws=1"),
        ("fake", 'link.device="udp:192.168.1.2:14560"'),
        ("vicon", "throws=1"),
        ("fake_betaflight", 'betaflight.device="serial:/dev/ttyACM0:115200"'),
        ("fake", 'source.device="udp:10.0.0.1:14561"'),
    ],
)
def test_auto_arm_is_refused_for_what_is_not_on_this_machine(base, override):
    params = load_run(base, (override, "link.remote=true"))
    with raises(
        RunError, match=r"--auto-arm with .*; it is for `visthrow hil fake` on this machine alone"
    ):
        require_fake(params)
    require_fake(load_run("fake_betaflight"))


def test_a_terminal_that_takes_nothing_holds_nobody_up(monkeypatch):
    gate = threading.Event()

    class Stuck:
        def write(self, text):
            gate.wait(10.0)
            raise BrokenPipeError

        def flush(self):
            pass

    monkeypatch.setattr("sys.stderr", Stuck())
    console, start = Console(), time.monotonic()
    for _ in range(5000):
        console.say("x")
    assert time.monotonic() - start < 1.0
    gate.set()
    console.close()
