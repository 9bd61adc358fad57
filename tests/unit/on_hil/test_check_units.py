"""`hil check` on live poses: a wrong unit shows as a failed check."""

import math

from pytest import mark

from hil.links.clock import ManualClock
from hil.poses.pose import Pose
from hil.poses.sources.pose_source import RecordedSource
from tests.hil_flight import OURS


def opened(poses):
    """Recorded poses as `hil.poses.sources.open_source.open_source` returns them."""
    source = RecordedSource(poses)
    return source, None, ManualClock(source.start)


@mark.parametrize("quat", [(0.0,) * 4, (math.nan,) * 4])
def test_an_attitude_that_is_none_is_told_in_words(monkeypatch, quat, printed):
    """Of the vehicle it fails; no library's sentence on quaternions comes up."""
    poses = [
        Pose(0.01 * i, 0.01 * i, body, (1e-4 * i, 0.0, z), quat)
        for i in range(200)
        for body, z in (("vehicle", 1.333), ("payload", 0.95))
    ]
    monkeypatch.setattr("hil.check.open_source", lambda *args: opened(poses))
    out = printed("hil check --seconds 1.9", sets=OURS, status=1)
    fails = [line for line in out.splitlines() if line.startswith("FAIL")]
    assert len(fails) == 2, "the vehicle's alone"
    assert fails[0] == "FAIL  no good pose of the vehicle"
    assert "vehicle: 100 % of the poses are refused" in fails[1]


def test_what_the_autopilot_check_found_fails_the_check(monkeypatch, printed):
    poses = [
        Pose(0.01 * i, 0.01 * i, body, (1e-4 * i, 0.0, z), (0.0, 0.0, 0.0, 1.0))
        for i in range(250)
        for body, z in (("vehicle", 1.333), ("payload", 0.95))
    ]
    monkeypatch.setattr("hil.check.open_source", lambda *args: opened(poses))
    results = [(True, "parameters were read"), (False, "hover share measured 0.9")]
    monkeypatch.setattr("hil.check.AutopilotCheck.results", lambda *args: results)
    lines = printed("hil check --seconds 2.4", sets=OURS, status=1).splitlines()
    assert lines[-2:] == ["parameters were read", "FAIL  hover share measured 0.9"]


def test_a_wrong_unit_of_a_live_source_fails_the_check(monkeypatch, printed):
    """Millimetres that a bridge sends as metres; the source is none of the recorded kinds, whose
    files are refused.
    """
    poses = []
    for i in range(200):
        t = 0.01 * i
        for body, z in (("vehicle", 1333.0), ("payload", 900.0)):
            poses.append(Pose(t, t, body, (300.0 * t, 0.0, z), (0.0, 0.0, 0.0, 1.0)))
    monkeypatch.setattr("hil.check.open_source", lambda *args: opened(poses))
    out = printed("hil check --seconds 1.9", sets=OURS, status=1)
    assert "FAIL  pos_w: 300 m/s" in out
    assert "FAIL  payload_pos_w: 300 m/s" in out
    assert "millimetres taken for metres?" in out
