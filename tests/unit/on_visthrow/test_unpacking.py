"""Files that unpack to far more than their size are refused before they are read; long reads report
their progress.
"""

import gzip
import lzma

import numpy as np
import pyarrow as pa
import pyarrow.parquet as pq
from pytest import importorskip, mark, raises
from scipy.io import savemat

from visthrow.common import storage
from visthrow.common.errors import LogError
from visthrow.common.storage import savez
from visthrow.logs import read
from visthrow.logs.readers.recordings import read_recording
from visthrow.logs.readers.table_to_log import read_table

ROWS = 140_000
TEXT = b"time,x\n" + b"0.000,0.000\n" * ROWS
ZEROS = np.zeros(ROWS)


def h5(path):
    with importorskip("h5py").File(path, "w") as file:
        file.create_dataset("x", data=ZEROS, compression="gzip")


WRITERS = {
    "x.csv.gz": lambda path: path.write_bytes(gzip.compress(TEXT)),
    "x.csv.xz": lambda path: path.write_bytes(lzma.compress(TEXT)),
    "x.parquet": lambda path: pq.write_table(pa.table({"time": ZEROS, "x": ZEROS}), path),
    "x.npz": lambda path: savez(path, {"x": ZEROS}),
    "x.mat": lambda path: savemat(path, {"x": ZEROS}, do_compression=True),
    "x.h5": h5,
}
READERS = {".mat": read_recording, ".h5": read_recording, ".npz": read}


@mark.parametrize("name", WRITERS)
def test_what_unpacks_to_too_much_is_not_read(name, tmp_path, monkeypatch):
    path = tmp_path / name
    WRITERS[name](path)
    reader = READERS.get(path.suffix, read_table)
    monkeypatch.setattr(storage, "MOST_UNPACKED", 1 << 20)
    monkeypatch.setattr(storage, "MOST_TIMES", 1)
    with raises(LogError, match=r"MB that unpack to at least [1-5] MB; expected 1 MB at"):
        reader(path)
    monkeypatch.setattr(storage, "MOST_UNPACKED", 1 << 24)
    if name == "x.npz":
        with raises(LogError, match="no entry 'header'"):
            reader(path)
    else:
        assert len(reader(path)["x"]) == ROWS


def test_a_long_read_says_how_far_it_is(tmp_path, monkeypatch, capsys):
    monkeypatch.setattr(storage, "PROGRESS_PERIOD", -1.0)
    path = tmp_path / "x.csv"
    path.write_text("a,b\n" + "1,2\n" * 3)
    read_table(path)
    assert f"{path}: 50% read" in capsys.readouterr().err
