"""Betaflight in software as a process: start it, write its settings over its command line, read
them back, end it.

The firmware keeps its settings (``eeprom.bin``) and its blackbox (``LOG00001.BFL``) in the folder
that it runs in. It ends itself where a board would restart, so it is started anew after ``save``.
It answers on its command line only while it is fed with samples of its sensors
(`hil.rehearsal.bridges.packets`), and listens on every address of the machine: keep it in a network
namespace (``unshare -rn``), or on a machine that nobody else reaches.

Source: betaflight 4.6, src/platform/SIMULATOR/sitl.c, src/main/cli/cli.c, src/main/msp/msp_box.c.
"""

import ctypes
import os
import signal
import socket
import subprocess
import sys
import time
from pathlib import Path

from hil.errors import RunError
from hil.links.backends.betaflight import FACTS, STICKS, BetaflightParams
from hil.rehearsal.bridges.packets import feed_at_rest, read_answer
from visthrow.common.toml_text import tables_beside

# TCP ports of the first two serial ports: the first is the runner's, the second the bridge's
PORTS = (FACTS["serial_port"] + 1, FACTS["serial_port"] + 2)
LAST_WORDS = 200  # of its output, in an error
LOOK_AGAIN = 0.02  # for a port that opens [s]
START = 20.0  # time for a start [s]
ANSWER = 20.0  # time for an answer of the command line [s]
END = 10.0  # time for the process's end [s]
FREED = 90.0  # longest wait for a port of the last firmware to be free [s]: TIME_WAIT is 60 s

LOCKSTEP = Path(__file__).with_name("lockstep.c")

PR_SET_PDEATHSIG = 1  # of prctl

_LIBC = ctypes.CDLL(None)

PROMPT = b"\n# "


def list_settings(params: BetaflightParams) -> dict[str, str]:
    """Return the settings that a throw needs, by the name or first words under which the command
    line prints them.
    """
    rates = params.rates
    out = tables_beside(__file__, "firmware_settings.toml")
    out |= {"rates_type": rates.type.upper(), "min_check": str(params.minimum_us)}
    for i, axis in enumerate(("roll", "pitch", "yaw")):
        out |= {
            f"{axis}_rc_rate": str(rates.rc_rates[i]),
            f"{axis}_srate": str(rates.rates[i]),
            f"{axis}_expo": str(rates.expo[i]),
        }
    if params.arm_channel:
        out["aux 0"] = f"0 {params.arm_channel - 1} 1700 2100 0 0"
    else:  # a receiver has all channels; the switch of MSP OVERRIDE is on AUX 2
        mask = (1 << STICKS) - 1 | 1 << STICKS + params.release_channel - 1
        out |= {
            "aux 0": "0 0 1700 2100 0 0",
            "aux 1": "50 1 1700 2100 0 0",
            "msp_override_channels_mask": str(mask),
        }
    return out


def line_of(name: str, value: str) -> str:
    """Return the command that sets a value:

    ``serial``, ``aux`` and ``feature`` have their own commands.
    """
    return f"{name} {value}" if " " in name else f"set {name} = {value}"


class Firmware:
    """One process of the firmware, in a ``folder`` of settings, blackbox and what it prints
    (``firmware.txt``).
    """

    def __init__(self, program: str | Path, folder: str | Path):
        """Name program and folder; nothing runs yet.

        Raises `RunError`: there is no such program.
        """
        self.program = Path(program).resolve()
        self.folder = Path(folder)
        if not self.program.is_file():
            raise RunError(
                f"no firmware at {program}; expected Betaflight's program for a PC, as `make"
                " TARGET=SITL` builds it"
            )
        self.folder.mkdir(parents=True, exist_ok=True)
        self._process: subprocess.Popen | None = None
        self.stands: int | None = None

    def start(self) -> None:
        """Start it, its clock by the stamps of its samples, and wait until it is ready for them:
        one that came before its sensors are begun would stop it for ever. Raises `RunError` where
        it ends, does not listen in time, or another one is there.
        """
        end = time.monotonic() + FREED
        # a connection of the last one may still be in TIME_WAIT
        while "failed" in (words := self._start()):
            self.stop()
            if time.monotonic() > end:
                raise RunError(f"the firmware cannot listen: {words!r}")
            time.sleep(1.0)
        if not read_answer(self.stands, START):
            self.stop()
            raise RunError(
                f"the firmware does not stand still {START:g} s after its start; its output:"
                f" {words!r}"
            )

    def _start(self) -> str:
        """Start the process; its words once it listens, or cannot."""
        try:  # nothing is connected, as the firmware serves one peer
            socket.create_server(("127.0.0.1", PORTS[0])).close()
        except OSError:
            raise RunError(
                f"something listens on port {PORTS[0]} already; expected no other firmware beside"
                " this one"
            ) from None
        self.stands, report = os.pipe()
        # by its place in the folder that it runs in: a path may hold no space
        library = compile_lockstep(self.folder).name
        environment = {**os.environ, "LD_PRELOAD": f"./{library}", "VISTHROW_STANDS": str(report)}
        # its errors; of what it prints, most are the words of its memory
        log = self.folder / "firmware.txt"
        with open(log, "wb") as errors:
            self._process = subprocess.Popen(
                [self.program],
                cwd=self.folder,
                stdin=subprocess.DEVNULL,
                stdout=subprocess.DEVNULL,
                stderr=errors,
                preexec_fn=_end_with_parent,
                env=environment,
                pass_fds=[report],
            )
        os.close(report)
        end = time.monotonic() + START
        while f"bind port {PORTS[0]} for UART1" not in (words := log.read_text(errors="replace")):
            if not self.runs or time.monotonic() > end:
                self.stop()
                raise RunError(
                    f"the firmware does not listen on port {PORTS[0]};"
                    f" its words: {words[-LAST_WORDS:]!r}"
                )
            time.sleep(LOOK_AGAIN)
        return words

    @property
    def runs(self) -> bool:
        """Whether the process runs."""
        return self._process is not None and self._process.poll() is None

    def stop(self) -> None:
        """End it."""
        self._end()
        if self.stands is not None:
            os.close(self.stands)
            self.stands = None

    def _end(self) -> None:
        """End the process, politely, then for good; whoever feeds it hears of it by its pipe."""
        if self._process is None:
            return
        self._process.terminate()
        try:
            self._process.wait(END)
        except subprocess.TimeoutExpired:
            self._process.kill()
            self._process.wait()
        self._process = None

    def set_up(self, settings: dict[str, str]) -> dict[str, str]:
        """Write settings, start anew, and return them as read back, then end; raises `RunError` for
        one that is not kept.
        """
        try:
            kept = self._write_settings(settings)
        finally:
            self.stop()
        wrong = [
            f"{name} is {kept[name]!r}, expected {value!r}"
            for name, value in settings.items()
            if kept[name] != value
        ]
        if wrong:
            raise RunError(f"the firmware did not keep its settings: {'; '.join(wrong)}")
        return kept

    def _write_settings(self, settings: dict[str, str]) -> dict[str, str]:
        self.start()
        with feed_at_rest(self.stands), CommandLine() as line:
            for name, value in settings.items():
                line.ask(line_of(name, value))
            line.save()
            self._end()
        self.stop()
        self.start()
        with feed_at_rest(self.stands), CommandLine() as line:
            return {name: line.read(name) for name in settings}


def compile_lockstep(folder: Path) -> Path:
    """Return the library of ``lockstep.c``, compiled into a folder where it is not there yet;
    raises `RunError` without a compiler.
    """
    library = folder.resolve() / "lockstep.so"
    if not library.exists():
        command = [
            os.environ.get("CC", "gcc"),
            "-O2",
            "-shared",
            "-fPIC",
            "-o",
            library,
            LOCKSTEP,
            "-lpthread",
        ]
        try:
            subprocess.run(command, check=True, capture_output=True, text=True)
        except (OSError, subprocess.CalledProcessError) as error:
            reason = getattr(error, "stderr", "") or error
            raise RunError(
                f"cannot compile {LOCKSTEP.name}: {reason}; expected a C compiler, as the"
                " firmware's own build has one"
            ) from error
    return library


class CommandLine:
    """The firmware's command line on its first serial port."""

    def __init__(self) -> None:
        """Connect and enter it. Raises `RunError`: nobody answers."""
        self._socket = socket.create_connection(("127.0.0.1", PORTS[0]), timeout=ANSWER)
        self._socket.sendall(b"#")
        self._read_until()

    def __enter__(self) -> "CommandLine":
        return self

    def __exit__(self, *_: object) -> None:
        self._socket.close()

    def _read_until(self, last: bytes = PROMPT) -> str:
        """Return the output up to the next prompt, or to other last words."""
        data = b""
        end = time.monotonic() + ANSWER
        while not data.endswith(last):
            self._socket.settimeout(max(end - time.monotonic(), 1e-3))
            try:
                chunk = self._socket.recv(65536)
            except TimeoutError:
                chunk = b""
            if not chunk:
                raise RunError(
                    "the firmware's command line does not answer;"
                    f" last output {data[-LAST_WORDS:]!r}"
                )
            data += chunk
        return data.decode("ascii", "replace")

    def ask(self, text: str) -> str:
        """Send a command and return its output. Raises `RunError`: it is refused."""
        self._socket.sendall(text.encode() + b"\n")
        answer = self._read_until()
        if "###ERROR" in answer:
            raise RunError(
                f"the firmware refuses {text!r}: {answer[answer.index('###') :].splitlines()[0]}"
            )
        return answer

    def read(self, name: str) -> str:
        """Return the value of a setting as the firmware prints it; empty if it prints none."""
        command = name.split()[0]
        answer = self.ask(command if " " in name else f"get {name}")
        start = f"{name} " if " " in name else f"{name} = "
        for text in answer.splitlines():
            if text.startswith(start):
                return text[len(start) :].strip()
        return ""

    def save(self) -> None:
        """Keep the settings: they are in its file when it says that it restarts.

        Raises `RunError`: it does not.
        """
        self._socket.sendall(b"save\n")
        self._read_until(b"Rebooting")


def _end_with_parent() -> None:
    """End the firmware when its parent process ends for any reason (Linux only)."""
    if sys.platform == "linux":
        _LIBC.prctl(PR_SET_PDEATHSIG, signal.SIGKILL)
