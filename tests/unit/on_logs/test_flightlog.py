"""The flight log: round trips, what it refuses, and what the exported tables hold."""

import numpy as np
from numpy.testing import assert_array_equal
from pytest import fixture, mark, raises

from visthrow.common.errors import LogError
from visthrow.logs.export import columns
from visthrow.logs.flightlog import Channel, FlightLog, FlightRecorder


@fixture
def log() -> FlightLog:
    recorder = FlightRecorder({"plant": "test", "goal": [2.0, 0.0]})
    recorder.declare("wind", "m/s", "world")
    for k in range(5):
        recorder.add(0.02 * k, pos_w=[k, 2.0 * k, 1.0], attached=k < 3)
        recorder.add(0.02 * k + 0.005, valid=k != 2, battery_voltage=16.0 - k if k != 2 else np.nan)
    recorder.add(0.0, wind=np.zeros(3, dtype=np.float32))
    recorder.add(0.05, landing=[1.9, 0.1, 0.04])
    return recorder.log()


def test_round_trip(log, tmp_path):
    log.save(tmp_path / "f.npz")
    loaded = FlightLog.load(tmp_path / "f.npz")
    assert loaded.meta == log.meta
    assert loaded.channels.keys() == log.channels.keys()
    for name, channel in log.channels.items():
        assert (loaded[name].unit, loaded[name].frame) == (channel.unit, channel.frame)
        assert loaded[name].values.dtype == channel.values.dtype
        for field in ("time", "values", "valid"):
            assert_array_equal(getattr(loaded[name], field), getattr(channel, field))


def test_recorder_copies_what_it_is_given():
    recorder, position = FlightRecorder(), np.zeros(3)
    recorder.add(0.0, pos_w=position)
    position += 1.0
    recorder.add(1.0, pos_w=position)
    assert_array_equal(recorder.log()["pos_w"].values, [[0, 0, 0], [1, 1, 1]])


def test_hold_returns_the_last_valid_sample(log):
    # Valid at 0.005, 0.025, 0.065, 0.085 s; the one at 0.045 s is not.
    held = log["battery_voltage"].hold(np.array([-1.0, 0.005, 0.024, 0.05, 0.065, 9.0]))
    assert_array_equal(held, [16.0, 16.0, 16.0, 15.0, 13.0, 12.0])
    with raises(LogError, match="no sample"):
        Channel(np.zeros(1), np.zeros(1), "m", valid=np.zeros(1)).hold(np.zeros(1))


@mark.parametrize(
    ("time", "values", "valid", "message"),
    [
        ([0.0, 1.0], [1.0], None, r"time \(2,\), values \(1,\)"),
        ([0.0, 1.0], [1.0, 2.0], [True], r"validity \(1,\)"),
        ([0.0, 0.2, 0.1], [1, 2, 3], None, "sample 1 is at 0.2 s, sample 2 at 0.1 s"),
        ([0.0, 0.0], [1, 2], None, "time must increase"),
        ([0.0, np.nan], [1, 2], None, "time stamp 1 is not finite"),
        ([0.0, 1.0], [1.0, np.inf], None, "marked valid is not finite"),
        ([0.0], ["x"], None, "numbers or bools"),
    ],
)
def test_contradictory_channels_are_refused(time, values, valid, message):
    with raises(LogError, match=message):
        Channel(
            np.array(time),
            np.array(values),
            "m",
            "world",
            None if valid is None else np.array(valid),
        )


def test_unknown_frames_are_refused():
    with raises(LogError, match="did you mean 'world'"):
        Channel(np.zeros(1), np.zeros(1), "m", "wrld")


def test_standard_names_keep_their_unit_frame_and_shape():
    time = np.zeros(1)
    with raises(LogError, match=r"'pos_w' is in unit and frame \('mm', 'world'\)"):
        FlightLog({"pos_w": Channel(time, np.zeros((1, 3)), "mm", "world")})
    with raises(LogError, match=r"samples of shape \(4,\); expected \(3,\)"):
        FlightLog({"pos_w": Channel(time, np.zeros((1, 4)), "m", "world")})
    FlightLog({"cable_points_w": Channel(time, np.zeros((1, 16, 3)), "m", "world")})


def test_missing_and_undeclared_channels_name_what_exists(log):
    with raises(LogError, match=r"no channel 'pos'; did you mean 'pos_w'"):
        log["pos"]
    with raises(LogError, match=r"'payload_pos' was not declared; did you mean 'payload_pos_w'"):
        FlightRecorder().add(0.0, payload_pos=[0, 0, 0])
    recorder = FlightRecorder()
    recorder.add(0.0, pos_w=[0, 0, 0])
    recorder.add(0.1, pos_w=[0, 0])
    with raises(LogError, match="channel 'pos_w'"):
        recorder.log()


def test_incomplete_files_are_refused(log, tmp_path):
    path = tmp_path / "f.npz"
    log.save(path)
    arrays = dict(np.load(path))
    del arrays["pos_w/time"]
    np.savez(path, **arrays)
    with raises(
        LogError, match="incomplete: no entry 'pos_w/time'; expected a flight log, it holds "
    ):
        FlightLog.load(path)
    np.savez(path, header=np.zeros(3, dtype=np.uint8))
    with raises(LogError, match="incomplete: Expecting value"):
        FlightLog.load(path)


def test_table_is_the_union_of_all_time_stamps(log):
    table = columns(log)
    # 5 stamps of pos_w, 5 of the voltage 5 ms later, 1 of the landing between them.
    assert len(table["time [s]"]) == 11
    assert table["pos_w[1] [m, world]"].compressed().tolist() == [0.0, 2.0, 4.0, 6.0, 8.0]
    assert table["battery_voltage [V]"].compressed().tolist() == [16.0, 15.0, 13.0, 12.0]
    assert table["landing[0] [m, world]"].count() == 1
