"""`visthrow hil check` on recordings: bodies without an attitude, exact cables, frames that are no
pose's.
"""

import math
import struct
import warnings

from pytest import mark

from hil.links.pymav import mav
from tests.commands import run_command

NAN = (math.nan,) * 4
LEVEL = (1.0, 0.0, 0.0, 0.0)
UNKNOWN = [0.0] * 21
SENDERS = """
base = "hil/dry_run.toml"
[source]
kind = "tlog"
file = "a.tlog"
senders = [
  {{ body = "vehicle", message = "{vehicle}", system = 1, component = 1 }},
  {{ body = "payload", message = "{payload}", system = 1, component = 25 }},
]
"""
MESSAGES = {"mocap": "ATT_POS_MOCAP", "odometry": "ODOMETRY", "vision": "VISION_POSITION_ESTIMATE"}


def message(kind, time, quat, place):
    """A pose at a time [s], north, east, down."""
    stamp = int(1e6 * (100.0 + time))
    if kind == "mocap":
        return mav.MAVLink_att_pos_mocap_message(stamp, quat, *place)
    if kind == "vision":
        return mav.MAVLink_vision_position_estimate_message(stamp, *place, *quat[1:])
    rest = (*[math.nan] * 6, UNKNOWN, UNKNOWN, 0, 0, 100)
    return mav.MAVLink_odometry_message(stamp, mav.MAV_FRAME_LOCAL_NED, 12, *place, quat, *rest)


def write(folder, payload, payload_quat):
    """Five seconds of a vehicle that sways, its payload straight below it."""
    names = {"vehicle": MESSAGES["mocap"], "payload": MESSAGES[payload]}
    (folder / "a.toml").write_text(SENDERS.format(**names))
    senders = [mav.MAVLink(None, 1, component) for component in (1, 25)]
    data = b""
    for i in range(500):
        x = 0.05 * math.sin(0.02 * i)
        pair = (
            message("mocap", 0.01 * i, LEVEL, (x, 0.0, -1.33)),
            message(payload, 0.01 * i, payload_quat, (x, 0.0, -0.83)),
        )
        for sender, part in zip(senders, pair):
            data += struct.pack(">Q", int(1e6 * (1.7e9 + 0.01 * i))) + bytes(part.pack(sender))
    (folder / "a.tlog").write_bytes(data)


def checked(folder, monkeypatch, capsys):
    monkeypatch.chdir(folder)
    with warnings.catch_warnings():
        warnings.simplefilter("error", RuntimeWarning)
        status = run_command("hil check --config a.toml")
    return status, capsys.readouterr().out


@mark.parametrize(
    ("payload", "quat"),
    [
        ("mocap", LEVEL),
        ("mocap", (0.0,) * 4),
        ("odometry", NAN),
        ("vision", NAN),
    ],
)
def test_a_ball_needs_no_attitude(payload, quat, tmp_path, monkeypatch, capsys):
    """Single markers come with an attitude of NaN or zeros; an exact cable divides by no zero."""
    write(tmp_path, payload, quat)
    status, out = checked(tmp_path, monkeypatch, capsys)
    assert status == 0, out
    assert "payload: 100 poses/s" in out
    assert out.count("refused: none") == 2
