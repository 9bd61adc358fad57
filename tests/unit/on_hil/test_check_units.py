"""`hil check` on live poses: a wrong unit shows as a failed check."""

from pytest import fixture

from hil.links.clock import ManualClock
from hil.poses.pose import Pose
from hil.poses.sources.pose_source import RecordedSource
from tests.hil_flight import OURS


@fixture
def checked(monkeypatch, printed):
    """What `hil check` prints of two bodies that move along x at a speed [m/s], at heights [m]; it
    fails.
    """

    def check(speed=0.01, heights=(1.333, 0.95)):
        level = (0.0, 0.0, 0.0, 1.0)
        times = [0.01 * i for i in range(200)]
        bodies = tuple(zip(("vehicle", "payload"), heights))
        poses = [Pose(t, t, name, (speed * t, 0.0, z), level) for t in times for name, z in bodies]
        source = RecordedSource(poses)
        opened = source, None, ManualClock(source.start)
        monkeypatch.setattr("hil.check.open_source", lambda *args: opened)
        return printed("hil check --seconds 1.9", sets=OURS, status=1).splitlines()

    return check


def test_what_the_autopilot_check_found_fails_the_check(monkeypatch, checked):
    results = [(True, "parameters were read"), (False, "hover share measured 0.9")]
    monkeypatch.setattr("hil.check.AutopilotCheck.results", lambda *args: results)
    assert checked()[-2:] == ["parameters were read", "FAIL  hover share measured 0.9"]


def test_a_wrong_unit_of_a_live_source_fails_the_check(checked):
    """Millimetres that a bridge sends as metres; the source is none of the recorded kinds, whose
    files are refused.
    """
    out = "\n".join(checked(300.0, (1333.0, 900.0)))
    assert "FAIL  pos_w: 300 m/s" in out
    assert "FAIL  payload_pos_w: 300 m/s" in out
    assert "millimetres taken for metres?" in out
