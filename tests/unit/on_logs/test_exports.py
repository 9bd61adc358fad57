"""Exports of motion capture and trajectories of data sets, each as its tool writes it."""

import csv
import io

import numpy as np
import pytest
from numpy.linalg import norm
from numpy.testing import assert_allclose
from pytest import approx, importorskip, raises
from scipy.spatial.transform import Rotation

from tests.flightlogs import asks
from visthrow.common.errors import LogError
from visthrow.diagnose.inputs.proposal import propose
from visthrow.logs import table_of
from visthrow.logs.readers.table_to_log import logs_of

TIME = 0.01 * np.arange(400)
YAW = 0.3


def motion(time=TIME):
    """Position [m], z up, and attitude of a vehicle whose lean makes its acceleration."""
    pos = np.column_stack([np.sin(1.2 * time), 0.5 * np.cos(1.7 * time), 1.5 + 0.1 * np.sin(time)])
    acc = np.column_stack(
        [
            -(1.2**2) * np.sin(1.2 * time),
            -0.5 * 1.7**2 * np.cos(1.7 * time),
            9.81 - 0.1 * np.sin(time),
        ]
    )
    up = acc / norm(acc, axis=1)[:, None]
    ahead = np.cross(np.cross(up, [np.cos(YAW), np.sin(YAW), 0.0]), up)
    ahead /= norm(ahead, axis=1)[:, None]
    return pos, Rotation.from_matrix(np.stack([ahead, np.cross(up, ahead), up], axis=-1))


POS, TURN = motion()
Y_UP = Rotation.from_matrix([[1, 0, 0], [0, 0, 1], [0, -1, 0]])  # of z up


def lines(rows, mark=",", comma=False):
    out = io.StringIO()
    csv.writer(out, delimiter=mark, lineterminator="\n").writerows(rows)
    return out.getvalue().replace(".", ",") if comma else out.getvalue()


def table_with(head, *columns):
    """Text of a table of columns beside the time."""
    return f"time,{head}\n{lines(np.column_stack([TIME, *columns]).tolist())}"


def motive(version="1.23", scale=1.0, units="Meters", gap=slice(0, 0)):
    places = POS @ Y_UP.as_matrix().T * scale
    quats = (Y_UP * TURN * Y_UP.inv()).as_quat()
    head = ["Format Version", version, "Take Name", "t", "Capture Frame Rate", "100.000000"]
    head += ["Export Frame Rate", "100.000000", "Rotation Type", "Quaternion"]
    head += ["Length Units", units, "Coordinate Space", "Global"]
    count = 8
    rows = [["", "Type"] + ["Rigid Body"] * count, ["", "Name"] + ["quad"] * count]
    rows.append(["", "ID"] + ["1" if version < "2" else "5B1F" * 8] * count)
    rows += [["", "Parent"] + [""] * count] if version > "2" else []
    kinds = ["Rotation"] * 4 + ["Position"] * 3 + ["Mean Marker Error"]
    rows += [["", "", *kinds], ["Frame", "Time (Seconds)", *"XYZWXYZ", ""]]
    for i, t in enumerate(TIME):
        lost = i in range(gap.start, gap.stop)
        cells = [""] * 8 if lost else [*quats[i].round(6), *places[i].round(6), 0.0002]
        rows.append([i, f"{t:.6f}", *cells])
    return lines([head]) + "\n" + lines(rows)


def vicon(kind="Objects", unit="rad", twice=False):
    vectors = TURN.as_rotvec() * (1.0 if unit == "rad" else 180.0 / np.pi)
    names = ["", "", "quad:quad", "", "", "", "", ""]
    rows = [names, ["Frame", "Sub Frame", "RX", "RY", "RZ", "TX", "TY", "TZ"]]
    rows.append(["", "", unit, unit, unit, "mm", "mm", "mm"])
    for i in range(len(TIME)):
        rows.append([i + 1, 0, *vectors[i].round(7), *(1e3 * POS[i]).round(4)])
    return f"{kind}\n100\n{lines(rows)}" + ("\n" if twice else "")


def qualisys():
    head = [("NO_OF_FRAMES", len(TIME)), ("NO_OF_BODIES", 1), ("FREQUENCY", 100)]
    head += [("DESCRIPTION", "--"), ("DATA_INCLUDED", "6D"), ("BODY_NAMES", "quad")]
    names = ["Frame", "Time", "quad X", "Y", "Z", "Roll", "Pitch", "Yaw", "Residual"]
    rows = [names + [f"Rot[{i}]" for i in range(9)]]
    matrices = TURN.as_matrix().transpose(0, 2, 1).reshape(-1, 9)
    for i, t in enumerate(TIME):
        place = (1e3 * POS[i]).round(4)
        rows.append([i + 1, f"{t:.5f}", *place, 0, 0, 0, 0.3, *matrices[i].round(7)])
    return lines(head, "\t") + lines(rows, "\t")


QUATS = TURN.as_quat()
XYZW = np.column_stack([TIME, POS.round(6), QUATS.round(7)]).tolist()
MM = np.column_stack([TIME, (1e3 * POS).round(3), QUATS]).tolist()
WXYZ = np.column_stack([TIME, POS, QUATS[:, [3, 0, 1, 2]]]).round(7).tolist()
TUM = lines([[f"{1e9 + t:.4f}", *row] for t, *row in XYZW], " ")
EXPORTS = {
    "motive 1.23.csv": motive(),
    "motive 3.csv": motive("3.0", scale=1e3, units="Millimeters"),
    "motive with a gap.csv": motive(gap=slice(100, 150)),
    "vicon nexus.csv": vicon(),
    "vicon tracker.csv": vicon("Objects", "deg", twice=True),
    "qualisys.tsv": qualisys(),
    "tum with a hash.txt": "# timestamp tx ty tz qx qy qz qw\n" + TUM,
    "tum with two hashes.txt": "# ground truth\n# timestamp tx ty tz qx qy qz qw\n" + TUM,
    "tum without a head.tum": TUM,
    "tum below a sentence.txt": "# TF Coordinate Frame: /optical(data: /optical)\n" + TUM,
    "euroc.csv": "#timestamp [ns],p_RS_R_x [m],p_RS_R_y [m],p_RS_R_z [m],q_RS_w [],q_RS_x [],"
    "q_RS_y [],q_RS_z []\n" + lines([[int(1e18 + 1e9 * t), *row] for t, *row in WXYZ]),
    "q1 to q4.csv": "time,x,y,z,q1,q2,q3,q4\n" + lines(WXYZ),
    "q0 to q3, vector first.csv": "time,x,y,z,q0,q1,q2,q3\n" + lines(XYZW),
    "names that say nothing.csv": "time,log.x,log.y,log.z,log.qx,log.qy,log.qz,log.qw\n"
    + lines(XYZW),
    "units in a second line.csv": "time,x,y,z,qx,qy,qz,qw\ns,mm,mm,mm,,,,\n" + lines(MM),
    "units in brackets.csv": "t[s],x[mm],y[mm],z[mm],qx,qy,qz,qw\n" + lines(MM),
    "semicolons and commas.csv": "time;x;y;z;qx;qy;qz;qw\n" + lines(XYZW, ";", comma=True),
    "motive without labels.csv": motive().replace(",Type,", ",,").replace(",Name,", ",,"),
    "vicon with devices.csv": "Devices\n1000\n,,Force,,\nFrame,Sub Frame,Fx,Fy,Fz\n,,N,N,N\n"
    + "".join(f"{i},{j},1.0,2.0,{i % 7}\n" for i in range(9) for j in range(10))
    + f"\n{vicon()}",
    "line ends of windows.csv": motive().replace("\n", "\r\n"),
}


@pytest.fixture
def proposed(tmp_path):
    """Function that writes a file; returns its table, the proposed mapping, and its logs."""

    def take(text, name="a.csv"):
        path = tmp_path / name
        path.write_text(text, newline="")
        table = table_of(path)
        proposal = propose(table, name)
        return table, proposal, logs_of(table, proposal.mapping, name)

    return take


def test_poses_of_kitti_are_matrices(proposed):
    """Twelve numbers a row without a head or a stamp: the upper rows of a pose, row by row."""
    poses = np.concatenate([TURN.as_matrix(), POS[:, :, None]], axis=2).reshape(-1, 12)
    _, proposal, (log,) = proposed(lines(poses.round(9).tolist(), " "), "00.txt")
    assert asks(proposal, "how far are the rows apart")
    assert_allclose(log["pos_w"].values, POS, atol=1e-6)
    turned = (Rotation.from_quat(log["quat_wb"].values) * TURN.inv()).magnitude()
    assert np.max(turned) < 1e-6


@pytest.mark.parametrize("name", EXPORTS)
def test_an_export_gives_the_motion_that_it_was_made_of(name, proposed):
    _, proposal, (log, *_) = proposed(EXPORTS[name], name)
    time = log["pos_w"].time - log["pos_w"].time[0]
    pos, turn = motion(time)
    good = log["pos_w"].valid
    assert np.sum(good) >= 350
    assert log["pos_w"].values[good] == approx(pos[good], abs=2e-3)
    attitude = log["quat_wb"]
    _, turn = motion(attitude.time - attitude.time[0])
    ours = Rotation.from_quat(attitude.values[attitude.valid])
    assert np.max((turn[attitude.valid].inv() * ours).magnitude()) < 2e-3
    assert not asks(proposal, "which axis is up")


@pytest.mark.parametrize("name", ["motive 3.csv", "vicon nexus.csv", "qualisys.tsv"])
def test_every_column_that_is_left_out_is_listed(name, proposed):
    table, proposal, _ = proposed(EXPORTS[name], name)
    used = {column for entry in proposal.mapping.channels for column in entry.columns}
    assert used | {proposal.mapping.time.column} | set(proposal.left_out) == set(table)
    assert any("Frame" in column for column in proposal.left_out)


def test_markers_of_a_c3d_file_are_read_and_hidden_ones_are_blank(tmp_path):
    c3d = importorskip("c3d")
    writer = c3d.Writer(point_rate=100.0, analog_rate=100.0)
    for i, place in enumerate(1e3 * POS):
        points = np.zeros((2, 5))
        points[0, :3], points[0, 3] = place, -1.0 if 100 <= i < 150 else 0.5
        writer.add_frames([(points, np.zeros((1, 1)))])
    writer.set_point_labels(["ball", "tip", "of no point"])
    writer.analog_group.set_empty_array("SCALE", "left out", 4)
    path = tmp_path / "a.c3d"
    with path.open("wb") as file:
        writer.write(file)
    table = table_of(path)
    assert np.sum(np.isnan(table["ball.X [mm]"])) == 50
    assert table["ball.Z [mm]"][0] == approx(1500.0, abs=0.1)
    assert table["time [s]"][-1] == approx(3.99)


def test_a_table_of_matlab_is_refused_by_its_kind(tmp_path):
    """The file of an object has an array without a name, as MATLAB writes it."""
    scipy_io = importorskip("scipy.io")
    path = tmp_path / "a.mat"
    scipy_io.savemat(path, {"a": np.arange(3.0)})
    data = bytearray(path.read_bytes())
    data[128 + 8 + 8] = 17  # the class of the array: an opaque object
    path.write_bytes(bytes(data))
    with raises(LogError, match="an object of MATLAB"):
        table_of(path)


@pytest.mark.parametrize("mode", ["all zero", "position zero", "held"])
def test_a_body_that_the_capture_lost_is_a_gap(mode, proposed):
    pos, quat = POS.copy(), QUATS.copy()
    pos[200:260] = pos[199] if mode == "held" else 0.0
    quat[200:260] = {"all zero": [0, 0, 0, 0], "position zero": [0, 0, 0, 1]}.get(mode, quat[199])
    text = table_with("x,y,z,qx,qy,qz,qw,px,py,pz", pos, quat, POS - [0.0, 0.0, 0.5])
    _, proposal, (log, *_) = proposed(text)
    assert "pos_w" in log
    if mode != "held":
        assert "payload_pos_w" in log
        assert np.array_equal(np.flatnonzero(~log["pos_w"].valid), np.arange(200, 260))
    assert not asks(proposal, "mirror")


@pytest.mark.parametrize("extra", ["", "EVENT\tThrow\t120\t1.2\n", "TRAJECTORY_TYPES\tA\tB\n"])
def test_markers_of_qualisys_without_names_of_columns(extra, proposed):
    """Places alone below the settings: the markers' names and the rate stand among these."""
    head = "NO_OF_FRAMES\t400\nNO_OF_MARKERS\t2\nFREQUENCY\t100\nDATA_INCLUDED\t3D\n"
    rows = (1e3 * np.column_stack([POS, POS - [0.0, 0.0, 0.5]])).round(3).tolist()
    text = f"{head}{extra}MARKER_NAMES\tquad\tball\n{lines(rows, chr(9))}"
    _, _, (log,) = proposed(text, "a.tsv")
    assert_allclose(log["pos_w"].values, POS, atol=1e-6)
    assert_allclose(log["payload_pos_w"].time[:3], [0.0, 0.01, 0.02])


def test_a_body_that_was_never_solved_is_named(tmp_path):
    path = tmp_path / "a.csv"
    path.write_text(motive(gap=slice(0, len(TIME))))
    table = table_of(path)
    assert "quad.Position.X [m]: blank throughout" in table.left_out


KINDS = {"Rotation": "deg", "Position": "m"}


def test_angles_in_degrees_are_no_position(proposed):
    """Euler angles whose order no name gives are left out and listed."""
    angles = TURN.as_euler("XYZ", degrees=True)
    names = [f"quad.{kind}.{axis} [{unit}]" for kind, unit in KINDS.items() for axis in "XYZ"]
    _, proposal, _ = proposed(table_with(",".join(names), angles, POS))
    entry = proposal.mapping.entry("pos_w")
    assert entry.columns[0] == "quad.Position.X [m]"
    assert "quad.Rotation.X [deg]" in proposal.left_out


QUESTIONS = {
    "gyro.x,gyro.y,gyro.z,acc.x,acc.y,acc.z": "rad/s or deg/s",
    "omega_x,omega_y,omega_z,acc_x,acc_y,acc_z": "rad/s or deg/s",
    "controller.r_roll,controller.r_pitch,controller.r_yaw,a,b,c": "body rates",
    "ctrl.roll,ctrl.pitch,ctrl.yaw,a,b,c": "angles, as assumed, or body rates",
}


@pytest.mark.parametrize("head", QUESTIONS)
def test_what_nothing_checks_becomes_a_question(head, proposed):
    rng = np.random.default_rng(0)
    rates = 0.5 * np.column_stack([np.sin(3 * TIME), np.cos(2 * TIME), np.sin(TIME)])
    acc = [0.0, 0.0, 1.0] + rng.normal(0.0, 0.01, (len(TIME), 3))
    _, proposal, _ = proposed(table_with(head, rates, acc))
    assert asks(proposal, QUESTIONS[head])


@pytest.mark.parametrize("frame", ["world", "body"])
def test_velocities_of_the_world_and_of_the_body_are_distinguished(frame, proposed):
    # it turns about itself all the while
    turn = Rotation.from_euler("z", 0.8 * TIME[:, None]) * TURN
    vel = np.gradient(POS, TIME, axis=0)
    vel = vel if frame == "world" else turn.inv().apply(vel)
    text = table_with("x,y,z,qx,qy,qz,qw,vx,vy,vz", POS, turn.as_quat(), vel)
    _, proposal, _ = proposed(text)
    names = {entry.name for entry in proposal.mapping.channels}
    assert ("vel_b" in names, "vel_w" in names) == (frame == "body", frame == "world")


def test_rotor_speeds_are_proposed_as_speeds(proposed):
    speeds = 6000.0 + 100.0 * np.sin(np.outer(TIME, [1.0, 1.1, 1.2, 1.3]))
    heads = {"rpm1,rpm2,rpm3,rpm4": "rpm", "m1[rad/s],m2[rad/s],m3[rad/s],m4[rad/s]": "rad/s"}
    for head, unit in heads.items():
        _, proposal, _ = proposed(table_with(f"x,y,z,{head}", POS, speeds))
        entry = proposal.mapping.entry("motor_speed")
        assert entry.unit == unit
