"""Flight logs made of run folders: channels, times, release and landing; the view of them, live and
recorded.
"""

import argparse
import json
import math
import shutil
import threading
import time
from dataclasses import replace

import cv2
import numpy as np
from numpy.linalg import norm
from numpy.random import default_rng
from numpy.testing import assert_allclose, assert_array_equal
from pytest import approx, fixture, importorskip

from hil.control.latch import PayloadFlight, separation
from hil.control.recording import flightlogs, view
from hil.control.recording.flightlogs import date_by_arrival, read, throws
from hil.control.recording.record import load_run
from hil.control.recording.run_report import finish
from tests.commands import run_python
from tests.hil_flight import TICK
from tests.hil_runs import copy_run, record_run, save_policy

LAG = 0.11
CLOCK = 3e-3
"""Tolerance of a time found in poses with a tenth of a millimetre of noise [s]."""


@fixture(scope="module")
def run(tmp_path_factory):
    folder = tmp_path_factory.mktemp("flown")
    decisions = record_run(folder / "a", save_policy(folder), seconds=6.0)
    return folder / "a", decisions


@fixture(scope="module")
def logs(run):
    return throws(read(run[0]))


def test_a_log_a_throw_with_what_was_decided(run, logs):
    _, decisions = run
    latches = [d for d in decisions if d.release]
    assert len(logs) == len(latches) == 1
    for log, latch in zip(logs, latches):
        times, result = log.meta["times"], log.meta["result"]
        assert result["success"]
        assert times["latch"] == latch.time
        assert times["policy_start"] <= latch.time
        assert times["separation"] == approx(latch.time + LAG, abs=TICK)
        throw = [d for d in decisions if d.action is not None and d.state == "throw"]
        shown = log["action"].values[np.searchsorted(log["action"].time, latch.time)]
        assert_array_equal(shown, next(d for d in throw if d.time == latch.time).action)
        assert result["error"] == approx(2.0, abs=0.02), (
            "it falls at its feet, the goal is 2 m away"
        )
        fall = math.sqrt(2 * (1.333 - 0.383 - 0.04) / 9.81)
        assert result["duration"] == approx(
            latch.time - times["policy_start"] + LAG + fall, abs=0.03
        )
        assert log["landing"].values[0][2] == approx(0.04)
        attached = log["attached"]
        assert attached.values[attached.time < times["separation"]].all()
        assert not attached.values[attached.time > times["separation"]].any()
        assert log["cable_points_w"].time[-1] < times["separation"]
        length = norm(np.diff(log["cable_points_w"].values, axis=1)[:, 0], axis=1)
        assert_allclose(length, length[0], atol=0.01)


def test_no_tick_is_in_the_logs_of_two_throws(run, monkeypatch):
    played = read(run[0])
    period = round(1.0 / played.playback.runner.pilot.period)  # ticks a second
    begin = played.throws[0][0]
    two = [(begin, begin + period // 2), (begin + period, begin + 3 * period // 2)]
    played.throws[:] = two
    ticks = []
    monkeypatch.setattr(
        flightlogs, "log_of", lambda _, first, last, number: ticks.append((first, last))
    )
    throws(played)
    (first, last), (following, _) = ticks
    assert first < begin
    assert last < two[1][0]
    assert following == last + 1


def test_commands_before_the_autopilot_follows_are_no_valid_ones(run, tmp_path):
    """As Betaflight has it while it is not armed: frames go out, motors stand still, and have to
    spin up.
    """
    lines = load_run(run[0])[2]
    first = next(n for n, line in enumerate(lines) if line["command"] is not None)
    lag = read(run[0]).playback.runner.pilot.policy.contract["vehicle"]["motor"]["time_constant"]
    late = [
        line["time"]
        for line in lines[first : first + 3 + math.ceil(flightlogs.SPUN_UP * lag / TICK)]
    ]

    def disarm(ticks):
        for tick in ticks[: first + 3]:
            tick["status"][3] = "wait"

    command = flightlogs.make_log(read(copy_run(run[0], tmp_path / "late", disarm)))["command"]
    assert command.time[~command.valid].tolist() == late
    assert len(command.time) > 10


def test_the_end_of_a_run_writes_logs_and_pictures(run):
    folder = run[0]
    messages = finish(folder)
    assert "throw 1: 2.0" in messages[0]
    assert len(list(folder.glob("throw-*.npz"))) == 1
    picture = cv2.imread(str(folder / "throw-01.png"))
    assert picture.shape[1] > 1500


def test_the_log_says_where_nothing_real_flew(run, logs, tmp_path):
    """A run at `visthrow hil fake` must not count as one of a vehicle."""
    assert logs[0].meta["plant_meaning"] == "poses of mavlink, back-end dry-run"
    shutil.copytree(run[0], tmp_path / "a")
    path = tmp_path / "a" / "summary.json"
    summary = json.loads(path.read_text())
    path.write_text(json.dumps({**summary, "links": [{"simulated": False}, {"simulated": True}]}))
    assert throws(read(tmp_path / "a"))[0].meta["plant_meaning"].endswith("of a simulated vehicle")


def test_poses_of_a_clock_that_drifts_are_dated_by_their_arrivals(tmp_path):
    """Stamps that gain a millisecond a second; by one offset a run's ends would be 3 ms off."""

    def drifting(time, poses):
        return [replace(pose, stamp=1.001 * pose.stamp + 40.0) for pose in poses]

    record_run(tmp_path / "a", save_policy(tmp_path), seconds=6.0, poses=drifting)
    played = read(tmp_path / "a")
    samples = [sample for tick in played.ticks for sample in tick.samples]
    off = [sample.time - date_by_arrival(sample, played.playback.params) for sample in samples]
    assert len(off) > 500
    assert np.abs(off).max() < 1e-3


def test_where_the_rope_let_go_is_found_in_noisy_poses():
    """A payload pulled with three times its weight until 0.113 s, then free; 1 mm of noise, 100 Hz,
    2 % lost.
    """
    rng, errors = default_rng(0), []
    for _ in range(40):
        let_go, start, vel = (
            0.113 + 0.01 * rng.random(),
            np.array([0.5, 0.0, 1.1]),
            np.array([4.0, 0.0, 2.0]),
        )
        pull = np.array([15.0, 0.0, 20.0])
        times = np.arange(-0.05, 0.5, 0.01) + 0.01 * rng.random()
        times = times[rng.random(len(times)) > 0.02]
        held = np.minimum(times - let_go, 0.0)[:, None]
        free = (times - let_go)[:, None]
        points = start + free * vel + [0, 0, -0.5 * 9.81] * free**2 + 0.5 * pull * held**2
        points = points + 1e-3 * rng.standard_normal(points.shape)
        when, where = separation(times, points, 0.11)
        errors.append(when - let_go)
        assert norm(np.subtract(where, start)) < 0.03
    assert abs(np.mean(errors)) < CLOCK
    assert np.std(errors) < 2 * CLOCK


def test_a_ball_lost_from_sight_before_the_ground_has_landed_all_the_same():
    """Released at 0.11 s from 1.1 m at 4 m/s; it is tracked until 60 ms, or 250 ms, before it
    lands.
    """
    fall = math.sqrt(2 * (1.1 - 0.04) / 9.81)
    for before, detected in ((0.06, True), (0.25, False)):
        flight = PayloadFlight((2.0, 0.0, 0.0), 0.0, 0.0, 0.04, 0.11)
        for t in np.arange(0.0, 0.11 + fall - before, 0.01):
            free = max(t - 0.11, 0.0)
            assert flight.add(t, (4.0 * free, 0.0, 1.1 - 0.5 * 9.81 * free * free)) is None
        assert flight.overdue(0.11 + fall + 0.02) is None, "not yet"
        landing = flight.overdue(0.11 + fall + 0.2)
        assert (landing is not None) == detected
        if detected:
            assert landing.time == approx(0.11 + fall, abs=1e-6)
            assert_allclose(landing.landing_w, (4.0 * fall, 0.0, 0.04), atol=1e-6)


def test_no_separation_where_the_poses_do_not_tell():
    times = np.arange(0.0, 0.1, 0.01)
    assert separation(times, np.zeros((10, 3)), 0.11) is None
    times = np.arange(0.0, 0.5, 0.01)
    fall = np.column_stack((times, 0 * times, -0.5 * 9.81 * times**2))
    assert separation(times, fall, 0.11) is None, "nothing ever held it"
    held = np.minimum(times - 0.11, 0.0)[:, None]
    gently = fall + 0.5 * np.array([0.0, 0.0, 4.0]) * held**2
    assert separation(times, gently, 0.11) is None, "a pull of 4 m/s2 hides when it ended"


def test_the_recording_of_a_run_holds_all(run, tmp_path):
    view.write(run[0], tmp_path / "run.rrd")
    data = (tmp_path / "run.rrd").read_bytes()
    assert data[:4] == b"RRF2"
    entities = run_python("-m", "rerun", "rrd", "print", tmp_path / "run.rrd", check=True).stdout
    for entity in (
        "/world/vehicle",
        "/world/ball",
        "/world/trail/ball",
        "/camera/goal",
        "/camera/payload",
        "/events",
        "/camera/body_axes",
        "/signals/age/vehicle",
        "/signals/tick/observation",
        "/signals/phase/state",
    ):
        assert entity in entities, entity


def test_the_same_run_as_mcap(run, tmp_path, capsys, monkeypatch):
    """`hil view --out run.mcap`, read back by the library's own reader."""
    reader = importorskip("mcap.reader")
    monkeypatch.setattr("visthrow.view.mcap_view.IMAGE_PERIOD", 1.0)
    out = tmp_path / "run.mcap"
    assert view.run(argparse.Namespace(folder=run[0], live=False, out=str(out))) == 0
    assert "open it with Foxglove" in capsys.readouterr().out
    with out.open("rb") as file:
        summary = reader.make_reader(file).get_summary()
    counts = summary.statistics.channel_message_counts
    flown = {channel.topic: counts[number] for number, channel in summary.channels.items()}
    assert flown["/vehicle"] > 100
    assert {"/camera/keypoints", "/events"} <= set(flown)


class Stream:
    """Stands for a stream of rerun: counts what is sent to each entity."""

    def __init__(self):
        self.sent = {}

    def log(self, entity, *what, static=False):
        self.sent[entity] = self.sent.get(entity, 0) + 1

    def send_columns(self, entity, indexes, columns):
        self.sent[entity] = self.sent.get(entity, 0) + 1

    def set_time(self, *args, **kwargs):
        pass


def test_the_live_view_follows_a_run_that_is_being_written(run, tmp_path, monkeypatch):
    """Lines come bit by bit, cut anywhere; all ticks are played back and the run's end ends the
    view.
    """
    monkeypatch.setattr(view, "POLL_INTERVAL", 0.01)
    source, folder = run[0], tmp_path / "live"
    folder.mkdir()
    for name in ("config.toml", "policy.npz", "provenance.json"):
        (folder / name).write_bytes((source / name).read_bytes())
    text = (source / "ticks.jsonl").read_text()

    def write():
        rng, place = default_rng(0), 0
        with (folder / "ticks.jsonl").open("w") as file:
            while place < len(text):
                step = int(rng.integers(0, 60_000))
                file.write(text[place : place + step])
                file.flush()
                place += step
                time.sleep(0.04)
        (folder / "summary.json").write_text("{}")

    stream, played = Stream(), []
    take = view.Show.take
    monkeypatch.setattr(
        view.Show, "take", lambda show, ticks: (played.extend(ticks), take(show, ticks))
    )
    writer = threading.Thread(target=write)
    writer.start()
    dropped = view.follow(folder, stream)
    writer.join()
    ticks = load_run(source)[2]
    assert len(played) + dropped == len(ticks)
    assert stream.sent["signals/phase/state"] > 2
    assert stream.sent["world/trail/ball"] > 2
    assert stream.sent["events"] >= 5
    assert_array_equal(
        [t.decision.command or () for t in played[-5:]],
        [line["command"] or () for line in ticks[-5:]],
    )
