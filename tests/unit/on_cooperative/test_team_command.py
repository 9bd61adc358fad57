"""``visthrow cooperative``: the shipped policies throw; bad names are reported."""

import json

import numpy as np
from pytest import approx

from tests.commands import run_command
from visthrow.cooperative.team_command import load
from visthrow.cooperative.throw_track import record_throw


def test_the_shipped_policy_lands_under_every_fault(tmp_path, capsys):
    file = tmp_path / "table.json"
    assert run_command(f"cooperative compare --throws 30 --json {file}") == 0
    rows = {row["fault"]: row for row in json.loads(file.read_text())}
    assert "late" in capsys.readouterr().out
    assert all(row["landed"] == 1.0 and row["contact"] == 0.0 for row in rows.values())
    assert rows["none"]["error_mean"] < 0.03
    assert max(row["error_mean"] for row in rows.values()) < 0.04
    assert rows["late"]["apart_mean"] == approx(0.03, abs=1e-3)


def test_a_drawn_flight_ends_where_and_when_the_load_lands():
    experiment, policy, _ = load("pair", "tree")
    track = record_throw(experiment, policy.act, target=2.0, seed=0)
    assert track.released
    off = np.linalg.norm(track.flight_w[-1, :2] - track.goal_w[:2])
    assert off == approx(track.landing_error, abs=1e-3)
    landing_height = experiment.release.landing_height
    assert track.flight_w[-1, 2] == approx(landing_height, abs=1e-3)
    assert np.diff(np.append(track.time, track.flight_time)).min() > 0.0
    centres = track.frames_w.mean((2, 3))
    np.testing.assert_allclose(centres, track.pos_w, atol=1e-6)


def test_a_missing_policy_is_reported(tmp_path, refused):
    refused(f"cooperative fly trio --out {tmp_path}", message="no policy 'trio'")
