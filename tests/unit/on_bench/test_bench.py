"""Benchmarks run with tiny sizes, count what the kernel does, and keep well-formed records; no time
is judged.
"""

import importlib
import shlex
from pathlib import Path

from pytest import fixture, mark, raises

from bench import report, start
from tests.configs import load_experiment
from visthrow import cli
from visthrow.common.errors import StorageError
from visthrow.onboard.policy import find_policy
from visthrow.paper import measurements


@fixture
def kept(tmp_path, monkeypatch) -> Path:
    monkeypatch.setattr(measurements, "FOLDER", tmp_path)
    return tmp_path


TORCHRUN = "torchrun --nproc-per-node 2 -m visthrow.cli"
RECORDS = sorted(measurements.FOLDER.glob("*.json"))


def test_shipped_records_are_well_formed():
    assert RECORDS
    for path in RECORDS:
        record = measurements.load(path)
        for table in record["tables"]:
            assert table["rows"], path.name
            assert all(len(row) == len(table["header"]) for row in table["rows"]), path.name
        assert record["provenance"]["commit"] != "unknown", (
            f"{path.name}: set VISTHROW_COMMIT where there is no history"
        )
        assert record["provenance"]["versions"]["warp-lang"], path.name
        assert measurements.body(record).startswith(f"### {record['title']}")
        assert measurements.origin(record)


@mark.parametrize("path", RECORDS, ids=lambda path: path.stem)
def test_the_command_of_today_beside_each_record_runs(path, monkeypatch):
    """Its options parse, its configurations exist and accept their changes, its policies exist or
    the line before makes them.
    """
    monkeypatch.setattr(start, "main", lambda parser, run, argv: parser.parse_args(argv))
    record = measurements.load(path)
    assert f"today, from a clone: `{record['today']}`" in measurements.origin(record)
    made = []
    for line in record["today"].split("; "):
        words = shlex.split(line.replace(TORCHRUN, "visthrow"))
        if words[0] == "visthrow":
            args = cli.build_parser().parse_args(words[1:])
            made.append(f"{args.out}/policy.npz")
            names = [args.config]
        else:
            assert words[:2] == ["python", "-m"]
            args = importlib.import_module(words[2]).main(words[3:])
            names = getattr(args, "configs", [])
        for name in names:
            load_experiment(name, args.overrides)
        for name in {
            *getattr(args, "policies", []),
            *([args.policy] if hasattr(args, "policy") else []),
        } - {*made}:
            find_policy(name)


def test_records_refuse_what_they_are_not(kept):
    (kept / "half.json").write_text('{"bench": "sim"')
    with raises(StorageError, match=r"half\.json: not a readable record"):
        measurements.load(kept / "half.json")
    (kept / "other.json").write_text("{}")
    with raises(StorageError, match="missing"):
        measurements.load(kept / "other.json")
    with raises(StorageError, match="expected lower-case"):
        report.record_path("../x")


def test_mistakes_are_reported(refused):
    refused("bench records no_such_record", message="no record")
