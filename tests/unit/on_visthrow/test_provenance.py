"""Provenance: complete, free of paths and names, and a run folder is never overwritten."""

import getpass
import json
import socket
import sys
import threading
import tomllib
import types
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass

from pytest import raises

from visthrow import config
from visthrow.common import provenance
from visthrow.common.errors import StorageError
from visthrow.common.storage import write_json


@dataclass(frozen=True)
class Settings:
    seed: int
    rate: float


def test_record_is_complete_and_free_of_names(monkeypatch):
    monkeypatch.setattr(
        sys,
        "argv",
        ["/home/somebody/bin/visthrow", "train", "--out=/data/x/run", "--set", "a.b=0.5/2"],
    )
    record = provenance.collect()
    assert record["command"] == "visthrow train --out=run --set a.b=0.5/2"
    assert {"commit", "time", "versions", "processors"} <= record.keys()
    assert record["versions"].keys() >= {
        "visthrow",
        "python",
        "numpy",
        "torch",
        "warp-lang",
        "rsl-rl-lib",
    }
    text = json.dumps({key: record[key] for key in record if key != "command"})
    for private in (socket.gethostname(), f"/{getpass.getuser()}/", "/home/"):
        assert private not in text


def test_a_command_is_one_that_a_shell_takes(monkeypatch):
    main = types.ModuleType("__main__")
    main.__spec__ = types.SimpleNamespace(name="bench.train")
    monkeypatch.setitem(sys.modules, "__main__", main)
    monkeypatch.setattr(
        sys, "argv", ["/root/bench/train.py", "state", "--set", 'algorithm="first_order"']
    )
    assert provenance.command() == "python -m bench.train state --set 'algorithm=\"first_order\"'"
    main.__spec__.name = "visthrow.cli.__main__"
    monkeypatch.setattr(sys, "argv", ["/root/visthrow/cli/__main__.py", "demo"])
    assert provenance.command() == "python -m visthrow.cli demo"


def test_commit_of_a_copy_without_history_is_what_was_given(monkeypatch, tmp_path):
    monkeypatch.setattr(
        provenance, "__file__", str(tmp_path / "visthrow" / "common" / "provenance.py")
    )
    monkeypatch.delenv(provenance.COMMIT_VARIABLE, raising=False)
    assert provenance.commit() == "unknown"
    monkeypatch.setenv(provenance.COMMIT_VARIABLE, "abc123")
    assert provenance.commit() == "abc123"


def test_run_folder_holds_config_and_record_and_is_not_overwritten(tmp_path):
    folder = tmp_path / "deep" / "run"
    written = provenance.write_run_folder(folder, config.dumps(Settings(3, 1e-3)), seed=3)
    assert tomllib.loads((folder / "config.toml").read_text()) == {"seed": 3, "rate": 1e-3}
    assert json.loads((folder / "provenance.json").read_text()) == written
    assert written["seed"] == 3
    with raises(StorageError, match="holds a run already"):
        provenance.write_run_folder(folder, config.dumps(Settings(4, 1.0)))
    provenance.write_run_folder(folder, config.dumps(Settings(4, 1.0)), resume=True)
    assert tomllib.loads((folder / "config.toml").read_text())["seed"] == 3
    assert (folder / "provenance_1.json").exists()


def test_json_has_no_nan(tmp_path):
    import numpy as np

    write_json(
        tmp_path / "a.json", {"a": float("nan"), "b": np.float32(1.5), "c": np.array([1.0, np.inf])}
    )
    assert json.loads((tmp_path / "a.json").read_text()) == {"a": None, "b": 1.5, "c": [1.0, None]}


def test_of_runs_that_begin_at_once_in_a_folder_one_goes_on(tmp_path):
    together = threading.Barrier(8)

    def begin(seed):
        together.wait()
        try:
            provenance.write_run_folder(tmp_path, config.dumps(Settings(seed, 1.0)), seed=seed)
        except StorageError:
            return None
        return seed

    with ThreadPoolExecutor(8) as pool:
        (seed,) = [seed for seed in pool.map(begin, range(8)) if seed is not None]
    assert json.loads((tmp_path / "provenance.json").read_text())["seed"] == seed
    assert tomllib.loads((tmp_path / "config.toml").read_text())["seed"] == seed


def test_a_folder_whose_config_cannot_be_written_stays_free(tmp_path, monkeypatch):
    def disk_is_full(path, content):
        raise StorageError(f"cannot write {path}: No space left on device")

    with monkeypatch.context() as patch:
        patch.setattr(provenance, "atomic_write", disk_is_full)
        with raises(StorageError, match="No space"):
            provenance.write_run_folder(tmp_path, "seed = 1\n")
    provenance.check_free(tmp_path)
