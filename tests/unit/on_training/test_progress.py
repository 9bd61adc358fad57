"""The log of a training: its file, the remaining time, its output."""

import csv

import numpy as np
from pytest import approx, fixture

from visthrow.task.measurement import Throws
from visthrow.training import progress

FIGURES = {"released": 1.0, "landing_error": 0.5, "rollout_s": 0.1, "learning_s": 0.1}


def throws(error: float = 0.05) -> Throws:
    landing = np.array([[2.0 + error, 0.0], [2.0, error], [np.nan, np.nan]])
    off = np.array([error, error, np.nan])
    blank = np.array([1.0, 1.0, np.nan])
    return Throws(2.0, np.array([True, True, False]), landing, off, blank, blank, blank)


@fixture
def clock(monkeypatch):
    """Ten seconds an iteration."""
    now = [100.0]
    monkeypatch.setattr(progress.time, "perf_counter", lambda: now[0])
    return now


def write_three(path, clock):
    """Write a log of three iterations, of which the last one ends with throws."""
    with progress.TrainLog(path, 1000, 10) as log:
        for i in range(1, 4):
            clock[0] += 10.0
            log.row(FIGURES | {"iteration": i}, throws() if i == 3 else None)


def rows_of(path):
    return list(csv.DictReader(path.open()))


def test_the_lines_show_errors_landings_and_the_time_left(tmp_path, clock, capsys):
    write_three(tmp_path / "p.csv", clock)
    (line,) = capsys.readouterr().out.splitlines()
    assert "1:10 left" in line  # seven iterations of ten seconds
    assert "0.0500 m, 1.000 s, landed 66.7 %" in line
    assert float(rows_of(tmp_path / "p.csv")[-1]["error_2m"]) == approx(0.05)
    assert float(rows_of(tmp_path / "p.csv")[-1]["landed_2m"]) == approx(2 / 3)


def test_a_resumed_log_goes_on_in_time_and_drops_what_is_made_again(tmp_path, clock, capsys):
    write_three(tmp_path / "p.csv", clock)
    with progress.TrainLog(tmp_path / "p.csv", 1000, 10, done=2, minutes=1.0) as log:
        clock[0] += 10.0
        log.row(FIGURES | {"iteration": 3}, throws())
        clock[0] += 60.0
        log.row(FIGURES | {"iteration": 4}, throws())
    assert [(int(r["iteration"]), float(r["wall_s"])) for r in rows_of(tmp_path / "p.csv")] == [
        (1, 10.0),
        (2, 20.0),
        (3, 30.0),
        (4, 90.0),
    ]
    _, before, after = capsys.readouterr().out.splitlines()
    assert "0:50 left" in before  # the minute ends before the seven iterations
    assert ", 0:00:00 left" in after
