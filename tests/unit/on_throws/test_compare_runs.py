"""The table of throws from HIL run folders: several policies, targets and throws a folder, failed
throws, wrong folders.
"""

import json

import numpy as np
from pytest import approx, raises

from hil.control.recording.run_report import finish
from tests.hil_runs import record_run, save_policy
from visthrow.common.errors import LogError
from visthrow.logs.flightlog import FlightLog, FlightRecorder
from visthrow.task.measurement import Throws
from visthrow.throws import from_runs


def log(
    policy="vision", goal=(2.0, 0.0, 0.0), landed=(2.1, 0.05, 0.04), sha="a", home=(0.0, 0.0, 1.333)
) -> FlightLog:
    """A throw of five ticks whose commands change by 0.1 each."""
    result = {"success": landed is not None, "failure": None if landed else "stale poses"}
    if landed:
        error = float(np.hypot(landed[0] - goal[0], landed[1] - goal[1]))
        result |= {"landing_w": list(landed), "error": error, "duration": 1.05}
    recorder = FlightRecorder(
        {
            "policy": policy,
            "policy_sha256": sha * 64,
            "layout": "vision",
            "plant": "poses",
            "plant_meaning": "poses of mavlink",
            "goal_w": list(goal),
            "home_w": list(home),
            "times": {"policy_start": 1.0, "recovery": 1.1},
            "result": result,
        }
    )
    for n in range(5):
        before, now = np.full(5, 0.1 * n), np.full(5, 0.1 * (n + 1))
        observation = np.zeros(69)
        observation[15:20] = before
        recorder.add(1.0 + 0.02 * n, action=now, observation=observation)
    return recorder.log()


def test_a_row_a_policy_and_target():
    logs = [log(landed=(2.0 + x, 0.0, 0.04)) for x in (-0.1, 0.1, 0.3)] + [log(landed=None)]
    logs += [
        log(goal=(1.5, 0.0, 0.0), landed=(1.5, 0.2, 0.04)),
        log("state", landed=(2.0, 0.0, 0.04), sha="b"),
    ]
    first, second = from_runs.entries(logs)
    assert (first.name, second.name) == ("state", "vision")
    at_15, at_2 = second.throws
    assert (at_15.target, at_2.target) == (1.5, 2.0)
    summary = at_2.summary()
    assert (summary["throws"], summary["success"]) == (4, 0.75)
    assert summary["error_mean"] == approx(0.5 / 3)
    assert summary["bias_x"] == approx(0.1)
    assert summary["smoothness"] == approx(0.1)
    assert at_15.summary()["bias_y"] == approx(0.2)
    assert first.throws[0].summary()["throws"] == 0, "the state policy did not throw at 1.5 m"


def test_policies_of_one_name_are_distinguished():
    names = [entry.name for entry in from_runs.entries([log(sha="a"), log(sha="b")])]
    assert names == ["vision aaaaaaaa", "vision bbbbbbbb"]


def test_a_goal_to_the_side_of_another_hover_point():
    (entry,) = from_runs.entries(
        [log(goal=(1.0, 4.0, 0.0), home=(1.0, 2.0, 1.3), landed=(0.9, 4.1, 0.04))]
    )
    (throws,) = entry.throws
    assert throws.target == 2.0
    np.testing.assert_allclose(throws.landing_w, [[2.1, 0.1]], atol=1e-9)


def test_the_command(tmp_path, printed):
    folder = tmp_path / "flown"
    record_run(folder, save_policy(tmp_path), seconds=6.0)
    finish(folder)
    other = tmp_path / "other"
    other.mkdir()
    log().save(other / "throw-01.npz")
    log(landed=None).save(other / "throw-02.npz")
    out = tmp_path / "out"
    runs = ["--from", str(folder), str(other)]
    text = printed(f"compare --out {out} --json {tmp_path}/t.json", *runs)
    assert "3 throws of 2 runs" in text
    assert "0.101 ± 0.106, 1.125 ± 0.029" in text, "the paper's figures beside ours"
    assert "do not say" in text
    assert {path.name for path in out.iterdir()} == {
        "compare-runs.md",
        "compare-runs.csv",
        "compare-runs.png",
    }
    rows = json.loads((tmp_path / "t.json").read_text())["rows"]
    flown = next(row for row in rows if row["policy"] == "always")
    assert flown["error_mean"] == approx(2.0, abs=0.02)
    assert isinstance(
        from_runs.entries([FlightLog.load(folder / "throw-01.npz")])[0].throws[0], Throws
    )


def test_the_note_does_not_contradict_the_title():
    unknown = log()
    simulated = FlightLog(unknown.channels, {**unknown.meta, "provenance": {"simulated": True}})
    assert from_runs.note([simulated]).endswith("A simulated vehicle flew these throws.")
    mixed = from_runs.note([simulated, unknown])
    assert "flew 1 of these 2 throws" in mixed
    assert "flew the others, the folders do not say" in mixed


def test_what_holds_no_throws(tmp_path, refused):
    refused(f"compare --from {tmp_path}/none", message="no such folder")
    (tmp_path / "summary.json").write_text("{}")
    with raises(LogError, match=r"no throw-\*.npz in it \(summary.json\).*visthrow hil view"):
        from_runs.logs_of([tmp_path])
    (tmp_path / "ticks.jsonl").write_text('{"n": 0, "state": "ready"}\n')
    with raises(LogError, match="No throw was started in this run"):
        from_runs.logs_of([tmp_path])
    bare = FlightLog({}, {"policy": "x"})
    with raises(LogError, match="does not hold a throw of a run"):
        from_runs.entries([bare])
    refused(f"compare vision --from {tmp_path}", message="the runs name theirs")
