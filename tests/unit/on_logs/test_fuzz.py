"""Damaged log files of every format: a readable flight log, or an error that names the damage;
nothing else, and soon.
"""

import gzip
import lzma
import math
import random
import signal
import struct
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from pathlib import Path

import numpy as np
from pytest import mark, raises

from tests import logfiles
from tests.commands import run_command
from tests.flightlogs import log_at, with_channels
from tests.places import DATA
from tests.unit.on_logs.test_autopilots import ulog, write_tlog
from visthrow.common.errors import LogError, VisthrowError
from visthrow.diagnose.inputs import setup as setups
from visthrow.logs import read
from visthrow.logs.check.run import check, table
from visthrow.logs.export import export
from visthrow.logs.flightlog import Channel, FlightLog

REAL = DATA / "real"
PATIENCE = 20.0
"""Seconds; the longest of these small files takes one on a busy machine."""
DAMAGES = 12
SAMPLES = 200

pytestmark = mark.filterwarnings("error::RuntimeWarning")


@contextmanager
def patience() -> Iterator[None]:
    """Raise TimeoutError where a reader goes round in circles."""

    def late(*_: object) -> None:
        raise TimeoutError(f"no end after {PATIENCE:g} s")

    before = signal.signal(signal.SIGALRM, late)
    signal.setitimer(signal.ITIMER_REAL, PATIENCE)
    try:
        yield
    finally:
        signal.setitimer(signal.ITIMER_REAL, 0.0)
        signal.signal(signal.SIGALRM, before)


def dataflash(path: Path) -> None:
    """Rates, accelerations, attitude and position."""
    imu = ("QBffffff", "TimeUS,I,GyrX,GyrY,GyrZ,AccX,AccY,AccZ")
    rows = [
        ("IMU", (10_000 * i, i % 2, math.sin(0.1 * i), 0.2, 0.3, 0.0, 0.0, -9.81))
        for i in range(SAMPLES)
    ]
    rows += [
        ("ATT", (10_000 * i, 0, 10.0 * math.sin(0.05 * i), 0, 5.0, 0, 90.0)) for i in range(SAMPLES)
    ]
    rows += [
        ("XKF1", (10_000 * i, 0, 0, 0, 0, 1.0, 0, 0, 0, 0.01 * i, 1.0, -2.0, 0, 0, 0, 0))
        for i in range(SAMPLES)
    ]
    logfiles.write_bin(path, {"IMU": imu, "ATT": logfiles.ATT, "XKF1": logfiles.XKF1}, rows)


def blackbox(path: Path) -> None:
    """A whole log and the beginning of another."""
    path.write_bytes((REAL / "betaflight_bbl" / "btfl_001_start.bbl").read_bytes()[:14_000])


def make_log() -> FlightLog:
    """A log of ours."""
    time, rng = 0.01 * np.arange(SAMPLES), np.random.default_rng(0)
    log = log_at(time, pos_w=rng.normal(size=(SAMPLES, 3)), attached=time < time[SAMPLES // 2])
    command = Channel(time[::2], np.ones((SAMPLES // 2, 4)), "N, rad/s", "body")
    return with_channels(log, command=command)


def lines_of(folder: str, name: str) -> bytes:
    """The head of a real table."""
    return b"".join(
        gzip.decompress((REAL / folder / name).read_bytes()).splitlines(keepends=True)[
            : SAMPLES + 1
        ]
    )


def payload_table() -> bytes:
    """A table that needs a mapping."""
    return lines_of("payload_cf_single", "log206.csv.gz")


FORMATS: dict[str, Callable[[Path], object]] = {
    "a.ulg": ulog,
    "a.BIN": dataflash,
    "a.tlog": lambda path: write_tlog(path, lambda mav, i: []),
    "a.bbl": blackbox,
    "a.npz": lambda path: make_log().save(path),
    "export.csv": lambda path: export(make_log(), path),
    "export.parquet": lambda path: export(make_log(), path),
    "payload.csv": lambda path: path.write_bytes(payload_table()),
    "payload.csv.gz": lambda path: path.write_bytes(gzip.compress(payload_table())),
    "payload.csv.xz": lambda path: path.write_bytes(lzma.compress(payload_table())),
    "decoded.csv": lambda path: path.write_bytes(
        lines_of("betaflight_bbl", "LOG00037_start.csv.gz")
    ),
}
WORDS = (
    b"nan",
    b"inf",
    b"1e400",
    b"",
    b'"',
    b",",
    b"\n",
    b"\x00",
    b"\xff",
    b"abc",
    b"True",
    b"-",
    b"1e300",
    b"\r",
)


def damage(data: bytes, chance: random.Random) -> bytes:
    """Bytes cut off, turned over, left out, doubled or replaced, now and then in the
    file's head.
    """
    out = bytearray(data)
    for _ in range(chance.choice((1, 1, 2, 5))):
        at = chance.randrange(min(len(out), 2000) if chance.random() < 0.3 else len(out))
        width = chance.choice((1, 2, 4, 16, 64, 500))
        kind = chance.randrange(7)
        if kind == 0:
            del out[at:]
        elif kind == 1:
            out[at] ^= 1 << chance.randrange(8)
        elif kind == 2:
            del out[at : at + width]
        elif kind == 3:
            out[at : at + width] = bytes(len(out[at : at + width]))
        elif kind == 4:
            out[at : at + width] = chance.randbytes(len(out[at : at + width]))
        elif kind == 5:
            out[at:at] = out[max(0, at - width) : at]
        else:
            out[at : at + chance.choice((0, 1, 3, 8))] = chance.choice(WORDS)
        if not out:
            break
    return bytes(out)


def is_readable(path: Path) -> bool:
    """Read and check a file; False where an error says why not."""
    mapping = setups.load("cf_payload").table if path.name.startswith("payload") else None
    message = ""
    try:
        with patience():
            for checked in check(read(path, mapping)):
                table(checked)
    except VisthrowError as error:
        message = str(error)
    assert not message or path.name in message
    return not message


def all_of(name: str, folder: Path, count: int) -> list[bool]:
    path, chance = folder / name, random.Random(name)
    FORMATS[name](path)
    whole = path.read_bytes()
    assert is_readable(path)
    readable = []
    for i in range(count):
        cut = whole[: len(whole) * i // (count // 3)]  # a third of them cut short, evenly
        path.write_bytes(cut if i < count // 3 else damage(whole, chance))
        readable.append(is_readable(path))
    return readable


MANY = 300


@mark.parametrize("name", list(FORMATS))
def test_damaged_files(name, tmp_path):
    readable = all_of(name, tmp_path, DAMAGES)
    assert not readable[0]  # nothing at all


def test_a_length_that_leads_back_is_no_circle(tmp_path):
    path = tmp_path / "a.ulg"
    ulog(path)
    data = path.read_bytes()
    first = data.index(b"A\x00\x00\x00vehicle_local_position") - 2  # the end of the definitions
    astray = data[16:first] * 8 + struct.pack("<HB", 400, 0) + bytes(90)
    path.write_bytes(data[:16] + astray)
    with patience(), raises(LogError, match="is invalid"):
        read(path)


def test_damaged_bytes_are_reported_in_one_row(tmp_path, capfd):
    path = tmp_path / "a.BIN"
    dataflash(path)
    data = bytearray(path.read_bytes())
    data[9000:9300] = bytes(300)
    path.write_bytes(data)
    code = run_command(f"diagnose check {path} --no-pictures --all")
    printed = capfd.readouterr()
    assert code in (0, 1)
    assert "damaged stretches in the file" in printed.out
    assert not printed.err


@mark.parametrize(
    ("name", "size", "factor", "words"),
    [
        ("battery_voltage", np.full(SAMPLES, 3700.0), 1e-3, "no such pack"),
        ("motor_command", np.full((SAMPLES, 4), 40_000.0), 1e-5, "no shares of the full command"),
    ],
)
def test_sizes_that_only_another_unit_gives(name, size, factor, words):
    for values, bad in ((size, True), (factor * size, False)):
        log = log_at(0.01 * np.arange(SAMPLES), **{name: values})
        assert any(words in row.text for row in check([log])[0].rows) == bad


@mark.slow
@mark.parametrize("name", list(FORMATS))
def test_many_damaged_files(name, tmp_path):
    readable = all_of(name, tmp_path, MANY)
    assert not all(readable)
