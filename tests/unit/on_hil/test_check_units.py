"""`hil check` on live poses: a wrong unit shows as a failed check."""

from hil.poses.pose import Pose
from hil.poses.sources.base import Recorded
from tests.hil_flight import OURS
from visthrow.cli import main


def test_a_wrong_unit_of_a_live_source_fails_the_check(monkeypatch, capsys):
    """Millimetres that a bridge sends as metres; the source is none of the recorded kinds, whose
    files are refused.
    """
    poses = []
    for i in range(200):
        t = 0.01 * i
        for body, z in (("vehicle", 1333.0), ("payload", 900.0)):
            poses.append(Pose(t, t, body, (300.0 * t, 0.0, z), (0.0, 0.0, 0.0, 1.0)))
    opened = (Recorded(poses), None, True)
    monkeypatch.setattr("hil.check.open_source", lambda *args: opened)
    command = [
        "hil",
        "check",
        "--seconds",
        "1.9",
        *(word for setting in OURS for word in ("--set", setting)),
    ]
    assert main(command) == 1
    out = capsys.readouterr().out
    assert "FAIL  pos_w: 300 m/s" in out
    assert "FAIL  payload_pos_w: 300 m/s" in out
    assert "millimetres taken for metres?" in out
