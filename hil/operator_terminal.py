"""The operator's terminal: typed commands, signals that end the process, and output. No call
ever waits.
"""

import contextlib
import os
import queue
import select
import signal
import sys
import threading
from collections.abc import Callable
from typing import Any

from hil.control.state_machine import OperatorInput, TickRecord
from visthrow.onboard.calibration import Calibration


def _signals(names: str) -> tuple[signal.Signals, ...]:
    """Return the signals of these names that this system has."""
    return tuple(getattr(signal, name) for name in names.split() if hasattr(signal, name))


ENDING = _signals(
    "SIGINT SIGTERM SIGHUP SIGQUIT SIGUSR1 SIGUSR2 SIGALRM SIGVTALRM SIGPROF SIGXCPU SIGPWR SIGIO"
)
"""Signals that would end the process and can be caught:

They come from Ctrl-C; from systemd, ``timeout`` and a shutdown; from a lost ssh connection or a
closed terminal; or are sent by mistake.
"""

PAUSING = _signals("SIGTSTP SIGTTIN SIGTTOU")
"""Signals that would stop the process in flight:

from Ctrl-Z, or because the terminal belongs to another job.
"""

MOST_UNSAID = 1000  # most lines that wait for a blocked terminal; further lines are lost
LAST_WORDS = 2.0  # longest wait for the output of the last lines at the end of a run [s]
MOST_TYPED = 4096  # most bytes kept of an incomplete line


class Console:
    """A printer to standard error with a separate thread, so that a closed or blocked terminal
    delays no tick.
    """

    def __init__(self) -> None:
        self._lines: queue.Queue[str | None] = queue.Queue(MOST_UNSAID)
        self._thread = threading.Thread(target=self._speak, name="console", daemon=True)
        self._thread.start()
        self._before: tuple[str, str] = ("", "")

    def say(self, text: str) -> None:
        """Print a line; never wait and never raise."""
        with contextlib.suppress(queue.Full):
            self._lines.put_nowait(text)

    def decision(self, decision: TickRecord) -> None:
        """Report a change of state with its reason, or what the state waits for; a reason is not
        repeated.
        """
        head = f"{decision.time:12.3f} s  {decision.state:8} "
        if decision.state != self._before[0]:
            self.say(head + (decision.reason if decision.reason != self._before[1] else ""))
            self._before = decision.state, decision.reason
        if decision.calibration is not None:
            estimate = decision.calibration
            self.say(
                f"{head}calibration:"
                f" {estimate if isinstance(estimate, str) else Calibration.of(estimate)}"
            )
        if decision.waits:
            self.say(f"{head}waits: {decision.waits}")

    def _speak(self) -> None:
        while (text := self._lines.get()) is not None:
            with contextlib.suppress(OSError, ValueError):
                print(text, file=sys.stderr, flush=True)

    def close(self) -> None:
        """Print the remaining lines, if the terminal accepts them in time."""
        with contextlib.suppress(queue.Full):
            self._lines.put_nowait(None)
        self._thread.join(LAST_WORDS)


class Terminal:
    """An operator at the terminal; implements `hil.control.loop.Operator`."""

    def __init__(
        self,
        auto_arm: bool = False,
        simulated: Callable[[], bool] = lambda: False,
        say: Callable[[str], None] = print,
    ):
        """Handle the signals. ``say``: prints a line and never waits. ``auto_arm``: arm whenever
        the run is ready, but only a vehicle that states that it is simulated.
        """
        self._auto = auto_arm
        self._simulated = simulated
        self._say = say
        self._why = ""
        self._typed = b""
        self._warned = False
        try:
            self._file = sys.stdin.fileno()
        except (AttributeError, OSError, ValueError):  # there is no terminal
            self._file = -1
        for number in ENDING:
            signal.signal(number, self._handle_signal)
        for number in PAUSING:
            signal.signal(number, signal.SIG_IGN)

    def _handle_signal(self, number: int, frame: Any) -> None:
        if number == signal.SIGINT and self._why.endswith("(Ctrl-C)"):
            raise KeyboardInterrupt
        if not self._why or number == signal.SIGINT:
            name = signal.Signals(number).name
            self._why = (
                "the operator said abort (Ctrl-C)"
                if number == signal.SIGINT
                else f"the process received {name}"
            )

    def words(self, state: str) -> OperatorInput:
        lines = self._lines()
        arm = "arm" in lines
        if self._auto and state == "ready" and not arm:
            arm = self._simulated()
            if not arm and not self._warned:
                self._warned = True
                self._say(
                    "--auto-arm: this vehicle does not say that it is simulated (`visthrow hil"
                    " fake` does); type arm"
                )
        return OperatorInput(arm, "land" in lines, "abort" in lines or bool(self._why), self._why)

    def _lines(self) -> set[str]:
        """Return the lines typed since the last call; an incomplete line waits for its end."""
        while self._file >= 0 and select.select([self._file], [], [], 0)[0]:
            try:
                data = os.read(self._file, MOST_TYPED)
            except OSError:  # the terminal has gone
                data = b""
            if not data:
                self._file = -1
            self._typed += data
        *whole, partial = self._typed.split(b"\n")
        self._typed = partial[-MOST_TYPED:] if self._file >= 0 else b""
        whole += [] if self._file >= 0 else [partial]
        return {line.decode("utf-8", "replace").strip().lower() for line in whole}
