"""Readers of logs: every format, what is wrong with files, and the raw blackbox against another
decoder.
"""

import gzip
import math
import random
import tomllib
from itertools import pairwise
from pathlib import Path

import numpy as np
from pytest import approx, mark, raises
from scipy.spatial.transform import Rotation

from tests import logfiles
from tests.flightlogs import log_at, with_channels
from tests.places import DATA
from visthrow import config
from visthrow.common.errors import ConfigError, LogError
from visthrow.diagnose.inputs import setup as setups
from visthrow.logs import read
from visthrow.logs.export import export
from visthrow.logs.flightlog import Channel
from visthrow.logs.mapping import ChannelMap, Split, TableMap, TimeColumn
from visthrow.logs.readers.blackbox import codec as blackbox_codec
from visthrow.logs.readers.blackbox import decoder as blackbox

REAL = DATA / "real"
BBL = REAL / "betaflight_bbl" / "btfl_001_start.bbl"


def signed_vb(value: int) -> bytes:
    return unsigned_vb((value << 1 ^ value >> 31) & 0xFFFFFFFF)


def unsigned_vb(value: int) -> bytes:
    out = bytearray()
    while value > 127:
        out.append(value & 127 | 128)
        value >>= 7
    return bytes([*out, value])


def bits(value: int, count: int) -> str:
    return format(value & (1 << count) - 1, f"0{count}b")


def pack(text: str) -> bytes:
    text += "0" * (-len(text) % 8)
    return bytes(int(text[i : i + 8], 2) for i in range(0, len(text), 8))


FORMS = tomllib.loads((DATA / "forms_of_logs.toml").read_text(encoding="utf-8"))


class TestCodec:
    """Each packing, written by the test from the format's description."""

    def test_numbers_of_variable_length(self):
        for value in (0, 1, -1, 63, -64, 64, 8191, -70000, 2**31 - 1, -(2**31)):
            assert blackbox_codec.Reader(signed_vb(value)).signed() == value
        assert blackbox_codec.Reader(unsigned_vb(2**32 - 1)).unsigned() == 2**32 - 1
        with raises(blackbox_codec.Corrupt):
            blackbox_codec.Reader(b"\xff" * 6).unsigned()
        with raises(blackbox_codec.EndOfLog):
            blackbox_codec.Reader(b"\xff").unsigned()

    def decode(self, code: int, data: bytes, fields: int) -> list[int]:
        reader, values = blackbox_codec.Reader(data), []
        for decoder, _, count in blackbox_codec.plan([code] * fields, [False] * fields):
            values += decoder(reader, count)[:count]
        assert reader.pos == len(data)
        return values

    def test_eight_fields_with_a_mask(self):
        assert self.decode(
            blackbox_codec.TAG8_8SVB, bytes([0b101]) + signed_vb(-3) + signed_vb(500), 3
        ) == [-3, 0, 500]
        assert self.decode(blackbox_codec.TAG8_8SVB, signed_vb(-3), 1) == [-3]
        nine = bytes([0b10000000]) + signed_vb(7) + signed_vb(8)
        assert self.decode(blackbox_codec.TAG8_8SVB, nine, 9) == [0] * 7 + [7, 8]

    @mark.parametrize(("code", "data", "values"), FORMS["codes"])
    def test_three_fields_with_a_selector(self, code, data, values):
        code = getattr(blackbox_codec, f"TAG2_{code}")
        assert self.decode(code, pack(data.replace(" ", "")), 3) == values

    def test_four_fields_of_nibbles(self):
        chance, widths = random.Random(3), (0, 4, 8, 16)
        for _ in range(200):
            kinds = [chance.randrange(4) for _ in range(4)]
            values = [
                chance.randrange(-(1 << w - 1), 1 << w - 1) if w else 0
                for w in (widths[k] for k in kinds)
            ]
            tag = sum(kind << 2 * i for i, kind in enumerate(kinds))
            data = bytes([tag]) + pack(
                "".join(bits(v, widths[k]) for v, k in zip(values, kinds) if k)
            )
            assert self.decode(blackbox_codec.TAG8_4S16, data, 4) == values

    def test_fourteen_bits_negated(self):
        assert self.decode(blackbox_codec.NEG_14BIT, unsigned_vb(-25 & 0x3FFF), 1) == [25]


class TestBlackbox:
    """A real raw file: two logs, the second cut within a frame."""

    def test_equals_another_decoder(self):
        logs, other = blackbox.read_blackbox(BBL), np.load(BBL.with_suffix(".orangebox.npz"))
        assert [len(log.main) for log in logs] == [98, 1930]
        for i, log in enumerate(logs, start=1):
            assert log.names == other[f"names{i}"].tolist()
            assert np.array_equal(log.main, other[f"log{i}"])
            assert np.all(np.diff(log.main[:, log.names.index("loopIteration")]) == 16)
            assert log.corrupt == log.dropped == 0
        assert logs[0].complete
        assert not logs[1].complete
        assert logs[0].events[-1] == ("end of log", ())

    def test_units_and_axes(self):
        log = read(BBL)[0]
        assert np.linalg.norm(log["acc_b"].values.mean(0)) == approx(9.81, rel=0.02)
        assert log["battery_voltage"].values.mean() == approx(24.6, abs=0.1)
        assert log["motor_command"].values.shape == (98, 4)
        decoded = blackbox.read_blackbox(BBL)[0]
        raw = dict(zip(decoded.names, decoded.main.T))
        front_left = (raw["motor[3]"] - 158) / (2047 - 158)
        assert log["motor_command"].values[:, 0] == approx(front_left)
        assert log["rate_b"].values[:, 2] == approx(np.radians(raw["gyroADC[2]"]))

    def test_damage_costs_frames_and_nothing_else(self):
        data = bytearray(BBL.read_bytes())
        clean = blackbox.read_blackbox(BBL)[1].main
        data[40_000:40_030] = bytes(30)
        log = self.of(bytes(data))[1]
        assert log.corrupt >= 1
        assert len(clean) - 40 < len(log.main) < len(clean)
        known = {row.tobytes() for row in clean}
        assert (
            sum(row.tobytes() not in known for row in log.main) <= 1
        )  # a damaged frame may still look like one

    def of(self, data: bytes):
        starts = [0, data.find(blackbox.MARKER, 1), len(data)]
        return [blackbox._Decoder(data[a:b]).decode() for a, b in pairwise(starts)]

    def test_no_blackbox(self, tmp_path):
        path = tmp_path / "a.bbl"
        path.write_bytes(bytes(range(256)) * 20)
        with raises(LogError, match="no blackbox log"):
            read(path)
        path.write_bytes(blackbox.MARKER + b"\nH Data version:2\n")
        with raises(LogError, match="does not define I and P frames"):
            read(path)
        path.write_bytes(BBL.read_bytes().replace(b"encoding:1,1,0", b"encoding:1,4,0"))
        with raises(LogError, match="encoding 4"):
            read(path)


PLACE = ChannelMap("x", ("v",), "m")


def mapping(*channels: ChannelMap, **more) -> TableMap:
    return TableMap(TimeColumn("t", "ms"), channels, **more)


def written(tmp_path: Path, rows: list[str], name: str = "a.csv") -> Path:
    path = tmp_path / name
    text = "\n".join(rows) + "\n"
    path.write_bytes(gzip.compress(text.encode()) if name.endswith(".gz") else text.encode())
    return path


def read_rows(tmp_path: Path, rows: list[str], *channels: ChannelMap, **more) -> list:
    return read(written(tmp_path, rows), mapping(*channels, **more))


class TestTables:
    """CSV and parquet by a mapping."""

    def test_units_axes_and_quaternion_order(self, tmp_path):
        turn = Rotation.from_euler("ZYX", [0.5, -0.2, 0.1])  # forward-right-down in north-east-down
        x, y, z, w = turn.as_quat()
        rows = [
            "t,n,e,d,qw,qx,qy,qz,r",
            *(f"{10 * i},{i},2,-3,{w},{x},{y},{z},90" for i in range(5)),
        ]
        (log,) = read(
            written(tmp_path, rows, "a.csv.gz"),
            mapping(
                ChannelMap("pos_w", ("n", "e", "d"), "cm", axes="x,-y,-z"),
                ChannelMap(
                    "quat_wb",
                    ("qw", "qx", "qy", "qz"),
                    "1",
                    "quaternion",
                    "wxyz",
                    "x,-y,-z",
                    "x,-y,-z",
                ),
                ChannelMap("turn", ("r",), "deg/s", frame="body"),
            ),
        )
        assert log["pos_w"].time == approx([0, 0.01, 0.02, 0.03, 0.04])
        assert log["pos_w"].values[4] == approx([0.04, -0.02, 0.03])
        assert log["turn"].values[0] == approx(math.pi / 2)
        vector = np.array([0.3, -0.7, 0.2])  # of the body, ours
        flip = np.array([1.0, -1.0, -1.0])
        expected = flip * turn.apply(flip * vector)
        assert Rotation.from_quat(log["quat_wb"].values[0]).apply(vector) == approx(expected)

    def test_angles_turn_yaw_first(self, tmp_path):
        rows = ["t,r,p,y", *(f"{i},10,20,30" for i in range(3))]
        angles = ChannelMap("quat_wb", ("r", "p", "y"), "deg", "euler")
        (log,) = read_rows(tmp_path, rows, angles)
        yaw, pitch, roll = (
            Rotation.from_euler(axis, angle, degrees=True)
            for axis, angle in (("z", 30), ("y", 20), ("x", 10))
        )
        expected = (yaw * pitch * roll).as_matrix()
        assert Rotation.from_quat(log["quat_wb"].values[0]).as_matrix() == approx(expected)

    def test_what_a_clock_does_wrong_is_counted_and_left_out(self, tmp_path):
        rows = ["t,v", "0,1", "10,2", "10,3", "20,4", "5,5", "30,", ",7", "40,8"]
        (log,) = read_rows(tmp_path, rows, PLACE)
        notes = log.meta["ingest"]["x"]
        assert log["x"].time == approx([0, 0.01, 0.02, 0.04])
        assert (notes["repeated"], notes["backwards"], notes["unstamped"], notes["blank"]) == (
            1,
            1,
            1,
            1,
        )

    @mark.parametrize(("rows", "entry", "values"), FORMS["columns"])
    def test_one_column(self, tmp_path, rows, entry, values):
        entry = {"name": "x", "columns": ("v",), "unit": "m"} | entry
        (log,) = read_rows(tmp_path, [rows], ChannelMap(**entry))
        period = 0.02 if entry.get("held") else 0.01
        assert log["x"].time == approx([0, period, 2 * period])
        assert log["x"].values.ravel() == approx(values)

    def test_blanks_are_no_samples_and_break_no_hold(self, tmp_path):
        """Two streams in one table: rows of the one are blank in the other; a part of a vector that
        is blank is a bad sample.
        """
        rows = [
            "t,v,a,b",
            *(f"{10 * i},{i // 6 if i % 2 else ''},{i if i % 3 else ''},{i}" for i in range(13)),
        ]
        held = ChannelMap("x", ("v",), "m", held=True)
        (log,) = read_rows(tmp_path, rows, held, ChannelMap("y", ("a", "b"), "m"))
        assert log["x"].time == approx([0.01, 0.07])
        assert np.all(log["x"].valid)
        assert len(log["y"].time) == 13
        assert log["y"].valid.tolist() == [i % 3 > 0 for i in range(13)]

    def test_no_header_and_lists_in_cells(self, tmp_path):
        (tmp_path / "a.csv").write_text(
            '0,"[1.0, 2.0, 3.0]"\n10,"[1.5, 2.0, 3.0]"\n20,"[2.0, 2.0]"\n'
        )
        listed = ChannelMap("pos_w", tuple(f"p[{i}]" for i in range(3)), "m")
        (tmp_path / "b.csv").write_text("t,p\n" + (tmp_path / "a.csv").read_text())
        (log,) = read(tmp_path / "b.csv", mapping(listed))
        assert log["pos_w"].values[1] == approx([1.5, 2.0, 3.0])
        assert log["pos_w"].valid.tolist() == [True, True, False]
        (tmp_path / "c.csv").write_text("0,1,2\n10,3,4\n20,5,6\n")
        columns = TableMap(TimeColumn("column 1", "ms"), (ChannelMap("x", ("column 3",), "m"),))
        (log,) = read(tmp_path / "c.csv", columns)
        assert log["x"].values == approx([2, 4, 6])

    def test_separate_clocks_and_splits(self, tmp_path):
        rows = ["t,u,b,v", *(f"{10 * i},{2 * i},{'ab'[i // 50]},{i}" for i in range(100))]
        logs = read_rows(
            tmp_path,
            rows,
            ChannelMap("x", ("v",), "m", clock="other"),
            ChannelMap("y", ("v",), "m"),
            clocks={"other": TimeColumn("u", "s")},
            split=Split("b"),
        )
        assert [log.meta["part"] for log in logs] == ["a", "b"]
        path = tmp_path / "a.csv"
        whole = mapping(ChannelMap("y", ("v",), "m"), split=Split("b"))
        assert [log.meta["part"] for log in read(f"{path}:b*", whole)] == ["b"]
        with raises(LogError, match="no part 'c' among 2"):
            read(f"{path}:c", whole)
        assert logs[1]["x"].time[0] == 100.0
        assert logs[1]["y"].time[0] == approx(0.5)

    @mark.parametrize(
        ("clock", "times"),
        [
            (TimeColumn("t", "ms", offset=0.5), [0.5, 0.51, 0.53]),
            (TimeColumn("t", "s", offset=-2.0), [-2.0, 8.0, 28.0]),
            (TimeColumn(row_period=0.02, offset=1.0), [1.0, 1.02, 1.04]),
            (TimeColumn("t", offset=1.0, offsets={"a.csv": 0.5, "b.csv": 9.0}), [1.5, 11.5, 31.5]),
        ],
    )
    def test_clocks(self, clock, times, tmp_path):
        path = written(tmp_path, ["t,v", "0,1", "10,2", "30,3"])
        (log,) = read(path, TableMap(clock, (PLACE,)))
        assert log["x"].time == approx(times)

    @mark.parametrize(
        ("gap", "shortest", "firsts"),
        [(0.05, 0.0, [1, 4, 6]), (0.07, 0.0, [1, 6]), (0.05, 0.015, [1, 6]), (0.05, 0.025, [6])],
    )
    def test_a_gap_begins_a_log_and_short_ones_are_left_out(self, gap, shortest, firsts, tmp_path):
        """Stretches of 20, 10 and 30 ms, gaps of 60 and 80 ms."""
        stamps = [0, 10, 20, 80, 90, 170, 180, 190, 200]
        rows = ["t,v", *(f"{stamp},{i}" for i, stamp in enumerate(stamps, start=1))]
        logs = read_rows(tmp_path, rows, PLACE, split=Split(gap=gap, shortest=shortest))
        assert [log["x"].values[0] for log in logs] == firsts

    def test_export_comes_back(self, tmp_path):
        time = np.arange(30) * 0.01
        log = log_at(time, pos_w=np.random.default_rng(0).normal(size=(30, 3)))
        command = Channel(time[::3], np.ones((10, 4)), "N, rad/s", "body")
        attached = Channel(time[::2], np.arange(15) < 9, "bool")
        log = with_channels(log, command=command, attached=attached)
        log.meta["who"] = "me"
        for ending in ("csv", "parquet"):
            export(log, tmp_path / f"a.{ending}")
            (back,) = read(tmp_path / f"a.{ending}")
            for name in log.channels:
                assert back[name].values == approx(log[name].values.astype(float))
                assert back[name].time == approx(log[name].time)
        assert back.meta["who"] == "me"
        with raises(LogError, match=r"'\.xlsx'; expected one of \.csv, \.parquet"):
            export(log, tmp_path / "f.xlsx")

    @mark.parametrize(("rows", "message"), FORMS["bad_tables"])
    def test_bad_tables(self, tmp_path, rows, message):
        with raises(LogError, match=message):
            read_rows(tmp_path, rows, PLACE)

    def test_damaged_files(self, tmp_path):
        with raises(LogError, match="needs a mapping"):
            read(written(tmp_path, ["t,v", "0,1"]))
        with raises(LogError, match="no such file; in that folder"):
            read(tmp_path / "b.csv")
        with raises(LogError, match=r"ending '\.doc'"):
            read(written(tmp_path, ["t,v\0"], "a.doc"))
        with raises(LogError, match="JSON"):
            read(written(tmp_path, ['{"t": 1,', '"x": 2}']))
        for name in "a.csv", "a.bin":
            with raises(LogError, match="a pointer of Git LFS"):
                read(written(tmp_path, ["version https://git-lfs.github.com/spec/v1"], name))
        (tmp_path / "run").mkdir()
        with raises(LogError, match="a folder without"):
            read(tmp_path / "run")

    @mark.parametrize(("change", "message"), FORMS["bad_mappings"])
    def test_bad_mappings(self, change, message):
        with raises(ConfigError, match=message):
            ChannelMap(**({"name": "pos_w", "columns": ("x", "y", "z"), "unit": "m"} | change))


class TestAutopilots:
    """Files written byte by byte."""

    def test_the_first_imu_alone_is_read(self, tmp_path):
        path, imu = tmp_path / "a.BIN", ("QBfff", "TimeUS,I,GyrX,GyrY,GyrZ")
        rows = [("IMU", (1000 * i, i % 2, 0.1 + i % 2, 0.2, 0.3)) for i in range(10)]
        logfiles.write_bin(path, {"IMU": imu}, rows)
        (log,) = read(path)
        assert log["rate_b"].values == approx(np.tile([0.1, -0.2, -0.3], (5, 1)))

    @mark.parametrize("ending", ["ulg", "BIN", "tlog", "bbl", "npz"])
    @mark.parametrize("data", [b"", b"nonsense" * 50, bytes(2000)])
    def test_no_such_log(self, tmp_path, ending, data):
        path = tmp_path / f"a.{ending}"
        path.write_bytes(data)
        with raises(LogError, match=rf"a\.{ending}"):
            read(path)


@mark.parametrize(
    "path", sorted((config.configs_root() / "diagnose").glob("*.toml")), ids=lambda p: p.stem
)
def test_shipped_mappings_name_channels_with_a_meaning_where_one_exists(path):
    setup = setups.load(path.stem)
    names = [channel.name for channel in setup.table.channels]
    assert len(set(names)) == len(names)
