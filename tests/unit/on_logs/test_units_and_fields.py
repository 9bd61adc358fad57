"""Every unit, and every field of every message that the readers of autopilots name, in a written
log: what comes out against numbers worked by hand.
"""

import struct
import tomllib

import numpy as np
from pymavlink.dialects.v20 import ardupilotmega as dialect
from pytest import approx, mark, raises

from tests import logfiles
from tests.places import DATA
from visthrow.common.errors import ConfigError
from visthrow.logs import read
from visthrow.logs.readers import autopilot_logs
from visthrow.logs.readers.blackbox import channels as blackbox
from visthrow.logs.unit_names import UNITS, to_si

TABLES = tomllib.loads((DATA / "autopilot_fields.toml").read_text(encoding="utf-8"))
ROWS = TABLES["rows"]
CASES = [(ending, *row) for ending, rows in ROWS.items() for row in rows]


def vector(value):
    """Return numbers, or the vector of a name."""
    return TABLES["vectors"][value] if isinstance(value, str) else value


def write_ulg(path, message, fields, values):
    words = [field.partition("*")[::2] for field in fields.split()]
    declared = [f"float[{count}] {name}" if count else f"float {name}" for name, count in words]
    rows = [(1_000_000 + 50_000 * i, *values) for i in range(5)]
    logfiles.write_ulg(path, {(message, 0): (["uint64_t timestamp", *declared], rows)})


def write_bin(path, message, fields, values):
    names = fields.split()
    form = ("Q" + "f" * len(names), ",".join(["TimeUS", *names]))
    rows = [(message, (1_000_000 + 50_000 * i, *values)) for i in range(5)]
    logfiles.write_bin(path, {message: form}, rows)


def write_tlog(path, message, fields, values):
    kind = getattr(dialect, f"MAVLink_{message.lower()}_message")
    lengths = dict(zip(kind.ordered_fieldnames, kind.array_lengths))
    content = {name: [0] * lengths[name] if lengths[name] else 0 for name in kind.fieldnames}
    rest = list(values)
    for word in fields.split():
        name, _, number = word.partition("=")
        name, _, count = name.partition("*")
        content[name] = int(number) if number else rest[: int(count)] if count else rest.pop(0)
    sender, out = dialect.MAVLink(None), b""
    for i in range(5):
        out += struct.pack(">Q", 1_700_000_000_000_000 + 20_000 * i)
        stamps = {"time_boot_ms": 20 * i, "time_usec": 20_000 * (i + 1)}
        out += kind(**content | {k: v for k, v in stamps.items() if k in content}).pack(sender)
    path.write_bytes(out)


WRITERS = {"ulg": write_ulg, "BIN": write_bin, "tlog": write_tlog}


def test_units():
    worked = {}
    for ours, units in TABLES["units"].items():
        worked |= {unit: (ours, size) for unit, size in units.items()}
    assert worked.keys() == UNITS.keys()
    for unit, (ours, size) in worked.items():
        assert to_si(unit, "here") == (ours, approx(size, rel=1e-10)), unit
    with raises(ConfigError, match=r"here: unit 'parsec'; known: .*, N, mN, gf, kgf"):
        to_si("parsec", "here")


@mark.parametrize(
    ("ending", "message", "fields", "values", "channel", "expected"),
    CASES,
    ids=[f"{ending}-{row[0]}-{row[1]}" for ending, *row in CASES],
)
def test_a_field_of_an_autopilot(ending, message, fields, values, channel, expected, tmp_path):
    path = tmp_path / f"a.{ending}"
    WRITERS[ending](path, message, fields, vector(values))
    (log,) = read(path)
    assert log.meta["ingest"][channel]["message"] == message
    got = log[channel].values.reshape(5, -1)
    if channel.endswith("quat_wb"):
        got = got * np.sign(got @ vector(expected))[:, None]  # both signs are one attitude
    np.testing.assert_allclose(got, np.tile(vector(expected), (5, 1)), rtol=1e-5, atol=1e-6)


@mark.parametrize(
    ("ending", "kind"), [("ulg", "ulog"), ("BIN", "dataflash"), ("tlog", "telemetry")]
)
def test_no_field_is_untested(ending, kind):
    taps = autopilot_logs.fields_of_autopilots()["taps"][kind]
    written = {(row[0], row[3]) for row in ROWS[ending]}
    named = {(tap.message, tap.channel) for tap in taps} - {("ESC", "motor_speed")}
    assert written == named


@mark.parametrize(("title", "value", "channel", "expected"), TABLES["decoded_blackbox"])
def test_a_field_of_a_decoded_blackbox(title, value, channel, expected):
    """Motor 3 is ours 0; a motor of 14 poles turns 100 / 7 times for one of eRPM."""
    rest = {f"{name}[{i}]" for name in ("gyroADC", "accSmooth", "setpoint") for i in range(3)}
    rest |= {f"{name}[{i}]" for name in ("motor", "eRPM") for i in range(4)}
    table = dict.fromkeys(rest, np.zeros(3)) | {"loopIteration": np.arange(3)}
    table.pop(title.split(" ")[0], None)
    table |= {"time (us)": np.array([0.0, 500.0, 1000.0]), title: np.full(3, value)}
    log = blackbox.log_of_decoded(table, "a.csv")
    assert log[channel].values.reshape(3, -1)[:, 0] == approx(expected)
    assert log[channel].time[-1] == approx(1e-3)


@mark.parametrize(("unit", "size"), [("us", 1e-6), ("ms", 1e-3), ("s", 1.0)])
def test_stamps_of_a_decoded_blackbox(unit, size):
    table = {f"time ({unit})": np.array([5.0, 6.0, 8.0]), "vbatLatest": np.ones(3)}
    log = blackbox.log_of_decoded(table, "a.csv")
    assert log["battery_voltage"].time == approx([0.0, size, 3.0 * size])


def test_the_clock_of_a_blackbox_turns_over():
    table = {"time": np.array([2.0**32 - 1000.0, 1000.0, 3000.0]), "vbatLatest": np.ones(3)}
    log = blackbox.log_of_decoded(table, "a.csv")
    assert log["battery_voltage"].time == approx([0.0, 0.002, 0.004])
