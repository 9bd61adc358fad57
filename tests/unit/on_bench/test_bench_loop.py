"""What closes the loop, but for flights and trainings: recording, extending, counting what was won
back.
"""

import json
from pathlib import Path
from types import SimpleNamespace

import numpy as np
import pytest

from bench import ablations, loop
from visthrow import config
from visthrow.common.errors import DiagnoseError
from visthrow.diagnose.throw import recorded
from visthrow.logs.flightlog import Channel, FlightLog
from visthrow.task import Experiment
from visthrow.throws.loading import load_policy


def throws(error: float, failed: int = 0) -> dict:
    """A hundred throws of about this error, some of which did not land."""
    spread = 1.0 + 0.1 * np.cos(np.arange(100))
    return {
        "error": list(error * spread),
        "success": [i >= failed for i in range(100)],
        "duration": [1.0] * 100,
    }


def test_share_won_back_by_hand():
    """From 0.10 m, of which 0.08 m are the effect's, to 0.04 m: 0.06 of 0.08."""
    found = loop.recovered({"before": throws(0.10), "after": throws(0.04), "oracle": throws(0.02)})
    assert found["share"] == pytest.approx(0.75, abs=1e-9)
    assert found["low"] < 0.75 < found["high"] < 0.8


def test_throws_that_did_not_land_do_not_count():
    part = throws(0.1, failed=40)
    part["error"][:40] = [np.inf] * 40
    assert len(loop.landed(part)) == 60
    none = throws(0.1, failed=100)
    assert np.isnan(
        loop.recovered({"before": none, "after": throws(0.1), "oracle": throws(0.1)})["share"]
    )


ABLATIONS = {
    "no_aerodynamics": "aerodynamics",
    "no_motor_lag": "motor_lag",
    "rigid_cable": "rope_flexible",
    "simple_controller": "controller_kind",
}


@pytest.mark.parametrize(("base", "effect"), ABLATIONS.items())
def test_a_model_that_lacks_a_block_becomes_the_whole_one_by_its_effect(base, effect):
    """What is hidden from an ablated model is the paper's plant, to the last number."""
    whole, ablated = (
        config.load(Experiment, config.find("train", name)) for name in ("state", f"state_{base}")
    )
    assert ablated != whole
    found = loop.extended(ablated, {effect: 1.0})
    assert (found.vehicle, found.rope, found.task) == (whole.vehicle, whole.rope, whole.task)


@pytest.mark.parametrize("theta", [{"motor_tau": 0.019}, {}], ids=["named", "failed"])
def test_the_round(theta, tmp_path, monkeypatch):
    """Stages in their order; the oracle is trained and flown whatever the diagnosis says, the other
    only if it names a cause.
    """
    trained, errors = [], {"before": 0.10, "after": 0.04, "oracle": 0.02}
    monkeypatch.setattr(loop.Loop, "_train", lambda self, name, say: trained.append(name))
    monkeypatch.setattr(
        loop.Loop, "_flights", lambda self, truth, say: [truth.vehicle.motor.time_constant]
    )
    monkeypatch.setattr(
        loop.Loop,
        "_diagnose",
        lambda self, logs, say: {"overall": "KNOWN", "theta": theta, "logs": logs},
    )
    monkeypatch.setattr(loop.Loop, "_throws", lambda self, name, policy, say: throws(errors[name]))
    record = loop.Loop({"motor_tau": 0.02}, tmp_path).run(lambda line: None)
    nominal = config.load(Experiment, config.find("train", "state")).vehicle.motor.time_constant
    hidden = config.load(Experiment, tmp_path / "hidden.toml").vehicle.motor
    assert max(hidden.time_constant, hidden.time_constant_down) == pytest.approx(nominal + 0.02)
    assert set(trained) == ({"oracle", "extended"} if theta else {"oracle"})
    assert (tmp_path / "extended.toml").exists() == bool(theta)
    assert record["recovered"]["share"] == pytest.approx(0.75 if theta else 0.0, abs=1e-9)
    assert loop.read([tmp_path])[0] == json.loads(json.dumps(record))


def test_throws_are_kept_and_not_flown_twice(tmp_path, monkeypatch):
    """What the plant says goes into a file, failed throws with it; the second time it is read."""
    flown = []

    class Flown:
        def __init__(self, loaded, targets, count, plant, seed, processes, size):
            flown.append((targets, count, plant, size))

        def __enter__(self):
            return self

        def __exit__(self, *_):
            pass

        def results(self, show):
            error = np.array([0.123456, np.nan])
            fields = {"success": np.array([True, False]), "error": error, "duration": error}
            return [[SimpleNamespace(**fields)]]

    monkeypatch.setattr("bench.loop.Throwing", Flown)
    monkeypatch.setattr("bench.loop.load_policy", lambda *_, **__: None)
    one = loop.Loop({}, tmp_path, throws=2)
    found = [one._throws("before", "state", lambda line: None) for _ in range(2)]
    assert flown == [((2.0,), 2, loop.PLANT, loop.BATCH)]
    for throws_ in found:
        np.testing.assert_array_equal(loop.landed(throws_), [0.1235])


def test_poses_are_recorded_with_the_noise_of_motion_capture_and_nothing_true():
    time = np.arange(0.0, 40.0, 0.02)
    level = np.tile([0.0, 0.0, 0.0, 1.0], (len(time), 1))
    place = np.zeros((len(time), 3))
    channels = {
        "pos_w": Channel(time, place, "m", "world"),
        "payload_pos_w": Channel(time, place, "m", "world"),
        "quat_wb": Channel(time, level, "1", "world"),
        "vel_w": Channel(time, place, "m/s", "world"),
        "command": Channel(time, np.tile([2.7, 0.0, 0.0, 0.0], (len(time), 1)), "N, rad/s", "body"),
        "release_command": Channel(time, np.zeros(len(time)), "1"),
    }
    meta = {
        "times": {"policy_start": 2.0, "landing": 38.0, "end": 40.0},
        "policy": "state",
        "plant": "reference",
    }
    seen = loop.recorded(FlightLog(channels, meta), np.random.default_rng(0))
    assert set(seen.channels) == {"pos_w", "payload_pos_w", "quat_wb", "command", "release_command"}
    assert seen["pos_w"].time[0] >= 2.0 - loop.BEFORE
    assert seen["payload_pos_w"].time[-1] <= 38.0 < seen["pos_w"].time[-1]
    for name in ("pos_w", "payload_pos_w"):
        assert seen[name].values.std() == pytest.approx(loop.NOISE[name], rel=0.05)
    assert 2.0 * seen["quat_wb"].values[:, :3].std() == pytest.approx(
        loop.NOISE["quat_wb"], rel=0.05
    )


def record_of(errors: dict, **more) -> dict:
    """A record of a loop."""
    flown = {name: throws(error) for name, error in errors.items()}
    told = {"hidden": {"motor_tau": 0.02}, "named": {"motor_tau": 0.019}, "throws": flown}
    return told | {"recovered": loop.recovered(flown)} | more


def test_finished_loops_are_shown_and_others_refused(tmp_path, monkeypatch):
    mine = tmp_path / "mine"
    mine.mkdir()
    (mine / loop.RECORD).write_text(
        json.dumps(
            record_of({"before": 0.10, "after": 0.04, "oracle": 0.02}, base="state_no_delay")
        )
    )
    text = loop.table(loop.read([mine]))
    assert "| motor_tau +0.02 (state_no_delay) | motor_tau +0.019 | 100 [" in text
    assert "| 75 % [" in text
    harmless = record_of({"before": 0.0201, "after": 0.02, "oracle": 0.02})
    assert "nothing was lost" in loop.table([harmless])
    lost = record_of(
        {"before": 0.02, "after": 0.02, "oracle": 0.02},
        recovered=dict.fromkeys(("share", "low", "high")),
    )
    assert loop.table([lost]).endswith("| - |")
    assert loop.picture([harmless])[:4] == b"\x89PNG"
    with pytest.raises(DiagnoseError, match="no such record"):
        loop.read([tmp_path / "elsewhere"])
    monkeypatch.setattr(loop, "COMMITTED", tmp_path / "committed")
    with pytest.raises(DiagnoseError, match="no records of loops"):
        loop.read()
    (tmp_path / "committed").mkdir()
    (tmp_path / "committed" / "a.json").write_text(json.dumps(harmless))
    assert loop.read()[0]["hidden"] == {"motor_tau": 0.02}


def test_throws_side_by_side_come_down_at_their_goals():
    """Each of a batch flies to its own goal, asks for its own release, and is logged as
    one flight.
    """
    goals = np.array([[1.4, 0.0, 0.0], [0.0, -1.2, 0.0]])
    logs = ablations.throws(load_policy("state"), "hybrid", goals, 0)
    for goal, log in zip(goals, logs):
        begin, landing = log.meta["times"]["policy_start"], log["landing"]
        assert np.linalg.norm(landing.values[0, :2] - goal[:2]) < 0.1
        asked = log["release_command"].values > 0.5
        assert begin < log["release_command"].time[asked][0] < landing.time[0]
        apart = np.linalg.norm(log["pos_w"].values - log["payload_pos_w"].values, axis=1)
        assert np.ptp(apart[log["pos_w"].time < begin]) < 0.01  # hangs still
        seen = loop.recorded(log, np.random.default_rng(0))
        assert "landing" not in seen
        assert recorded.record_of(seen, 0).latch == pytest.approx(
            log["release_command"].time[asked][0]
        )
    assert np.linalg.norm(logs[0]["landing"].values - logs[1]["landing"].values) > 1.0


def test_a_batch_that_does_not_come_down_is_an_error(monkeypatch):
    monkeypatch.setattr("visthrow.throws.flight.FALL_TIME", -10.0)
    with pytest.raises(DiagnoseError, match="did not come down"):
        ablations.throws(load_policy("state"), "hybrid", np.array([[1.4, 0.0, 0.0]]), 0)


@pytest.fixture
def ablated(monkeypatch):
    """A round without flights: every block is named but the rope's; what was asked for
    is counted.
    """
    asked = []

    def explained(logs, base, answer, device, say):
        asked.append((base, len(logs)))
        name = ablations.LACKS[base.removeprefix("state_")]
        theta = (
            {}
            if name == "rope_flexible"
            else {name: 1.0, **({"com_x": 1e-3} if name == "motor_lag" else {})}
        )
        findings = [{"name": n, "nats": 100.0} for n in theta]
        return {
            "overall": "KNOWN",
            "theta": theta,
            "findings": findings,
            "seconds": 9.0,
            "reasons": [],
            "threshold": 10.0,
        }

    def held(base, theta, lacks, logs, device):
        asked.append((lacks, len(logs)))
        return {"before": 50.0, "after": 1.0 if theta else 50.0, "samples": 9} | {
            f"landing_{who}": off
            for who, off in (("before", 0.08), ("after", 0.002), ("whole", None))
        }

    paths = lambda self, say: [Path(f"{i}.npz") for i in range(self.flights + self.held)]  # noqa: E731
    monkeypatch.setattr(ablations.Ablations, "_flown", paths)
    monkeypatch.setattr(ablations, "explained", explained)
    monkeypatch.setattr(ablations, "on_held_back", held)
    return asked


def test_models_that_lack_a_block_are_held_against_the_same_flights(tmp_path, ablated):
    record = ablations.Ablations(tmp_path, flights=4, held=2).run(lambda line: None)
    for base, lacks in ablations.LACKS.items():
        assert (f"state_{base}", 4) in ablated
        assert (lacks, 2) in ablated
    text = ablations.table(ablations.read(tmp_path))
    assert (
        "| controller_kind (state_simple_controller) | controller_kind +1 (100 nats) | KNOWN,"
        " named |" in text
    )
    assert "| 50 -> 1 | 80 -> 2 | 9 |" in text
    assert "KNOWN, named, with others" in text
    assert "nothing | KNOWN, not named" in text
    assert record == ablations.read(tmp_path / "record.json")
    ablations.Ablations(tmp_path, ["rigid_cable"], flights=4, held=2).run(lambda line: None)
    assert ablated.count(("rope_flexible", 2)) == 1  # what is there is not weighed again


def test_ablations_that_are_not_there_are_refused(tmp_path, ablated):
    with pytest.raises(DiagnoseError, match="no ablation no_rope; there are no_aerodynamics"):
        ablations.Ablations(tmp_path, ["no_rope"]).run(lambda line: None)
    with pytest.raises(DiagnoseError, match="no such record"):
        ablations.read(tmp_path / "nowhere")
