"""The folder of a run, its replay, and the commands; without a wire."""

import json
import math
import shutil
import tomllib
from dataclasses import replace

import numpy as np
from pytest import fixture, raises

from bench.processes import free_port
from hil.control.recording.record import RunRecorder, lines, load_run
from hil.control.recording.view import follow
from hil.errors import RunError
from tests.commands import run_command
from tests.hil_flight import params
from tests.hil_runs import copy_run, record_run
from visthrow.cli import main
from visthrow.common.errors import StorageError
from visthrow.common.toml_text import dumps
from visthrow.onboard.policy import Policy, find_policy


@fixture(scope="module")
def run_folder(tmp_path_factory):
    folder = tmp_path_factory.mktemp("run") / "a"

    def spoil(time, poses):
        """A few poses that no gate lets through: these must read back as well."""
        if int(time * 100) % 50 == 7:
            return [replace(pose, pos=(math.nan, math.inf, 0.0)) for pose in poses]
        return poses

    record_run(folder, "policy=vision", "observe=true", poses=spoil)
    return folder


def test_one_bit_that_differs_is_found(run_folder, tmp_path, printed):
    def turn_a_bit(ticks):
        action = ticks[100]["action"]
        action[1] = float(np.nextafter(np.float32(action[1]), np.float32(1.0)))

    copy_run(run_folder, tmp_path, turn_a_bit)
    assert "tick 100: action was" in printed(f"hil replay {tmp_path}", status=1)


def test_a_folder_cut_short_by_a_kill_replays(run_folder, tmp_path, capsys, printed):
    shutil.copytree(run_folder, tmp_path, dirs_exist_ok=True)
    data = (tmp_path / "ticks.jsonl").read_bytes()
    rows = data.splitlines(keepends=True)
    (tmp_path / "ticks.jsonl").write_bytes(b"".join(rows[:50] + rows[53:]))
    assert f"CUT: 3 of {len(rows)} ticks are missing" in printed(f"hil replay {tmp_path}", status=1)
    (tmp_path / "ticks.jsonl").write_bytes(data[: len(data) // 2])
    (tmp_path / "summary.json").unlink()
    assert run_command(f"hil replay {tmp_path}") == 1, (
        "what there is is the same, and not all is there"
    )
    out = capsys.readouterr().out
    assert "all bit for bit the same" in out
    assert "CUT: no summary" in out
    assert 100 < int(out.split()[0]) < len(load_run(run_folder)[2]), "about half of the ticks"


def test_what_is_no_run(run_folder, tmp_path, capsys):
    with raises(RunError, match="not the folder of a run; expected config"):
        load_run(tmp_path)
    for action in (["replay"], ["view"], ["check", "--hover-of"]):
        assert main(["hil", *action, str(tmp_path / "none")]) == 2
        assert "not the folder of a run" in capsys.readouterr().err
    shutil.copytree(run_folder, tmp_path, dirs_exist_ok=True)
    (tmp_path / "ticks.jsonl").write_text('{"n": 0\n{"n": 1}\n')
    with raises(RunError, match="line 1 is damaged"):
        load_run(tmp_path)
    (tmp_path / "ticks.jsonl").write_text('{"n": 0}\n')
    with raises(RunError, match="ticks or poses are damaged: KeyError"):
        load_run(tmp_path)


def test_a_run_with_its_poses_apart_and_without_later_keys_replays(run_folder, tmp_path, printed):
    shutil.copytree(run_folder, tmp_path / "before")
    config = tmp_path / "before" / "config.toml"
    tree = tomllib.loads(config.read_text())
    del tree["aim"], tree["check"]["probe"]
    tree["camera"]["noise"]["seen_radius"] = tree["camera"]["noise"].pop("visible_radius")
    config.write_text(dumps(tree))
    settings = load_run(tmp_path / "before")[0]
    assert (settings.aim, settings.check.probe) == (None, 0.0)
    ticks = list(lines(run_folder / "ticks.jsonl"))
    poses = [[line["n"], *row] for line in ticks for row in line["poses"]]
    former = [line | {"poses": len(line["poses"])} for line in ticks]
    for name, rows in (("ticks", former), ("poses", poses)):
        text = "".join(json.dumps(row) + "\n" for row in rows)
        (tmp_path / "before" / f"{name}.jsonl").write_text(text)
    assert "all bit for bit the same" in printed(f"hil replay {tmp_path}/before")
    with raises(RunError, match="leave out --live"):
        follow(tmp_path / "before", None)
    # killed while its poses were behind its ticks
    (tmp_path / "before" / "summary.json").unlink()
    (tmp_path / "before" / "poses.jsonl").write_text(text[: len(text) // 2])
    assert "all bit for bit the same" in printed(f"hil replay {tmp_path}/before", status=1)
    (tmp_path / "before" / "poses.jsonl").write_text("7\n")
    with raises(RunError, match="ticks or poses are damaged: TypeError"):
        load_run(tmp_path / "before")


def test_a_folder_that_cannot_be_made(tmp_path, capsys):
    (tmp_path / "file").touch()
    device = f'link.device="udp:127.0.0.1:{free_port()}"'
    assert run_command(f"hil run --out {tmp_path}/file/run --set {device}") == 2
    assert "cannot write" in (error := capsys.readouterr().err)
    assert "--out" in error


def test_a_run_that_is_refused_leaves_nothing_new_and_nothing_changed(
    run_folder, tmp_path, refused
):
    """The links write before there is a recorder: a second run into a folder emptied the first
    one's link.tlog.
    """
    device = f'link.device="udp:127.0.0.1:{free_port()}"'
    first = tmp_path / "first"
    shutil.copytree(run_folder, first)
    (first / "link.tlog").write_bytes(b"of the first run")
    refused(f"hil run --out {first} --set {device}", message="holds a run already")
    assert (first / "link.tlog").read_bytes() == b"of the first run"
    late = "--config fake_betaflight --set betaflight.device=tcp:127.0.0.1:9"  # no listener
    refused(f"hil run --out {tmp_path}/new --set {device} {late}", message="cannot connect")
    assert not (tmp_path / "new").exists()


def test_a_view_is_a_recording(run_folder, tmp_path, refused):
    refused(f"hil view {run_folder} --out {tmp_path}/a.txt", message="ends in .rrd or .mcap")
    assert not (tmp_path / "a.txt").exists()


def test_the_folder_holds_config_policy_and_hash(run_folder):
    loaded, policy, ticks = load_run(run_folder)
    assert loaded == params("policy=vision", "observe=true")
    assert policy.obs_dim == Policy.load(find_policy("vision")).obs_dim
    record = json.loads((run_folder / "provenance.json").read_text())
    assert record["policy"] == "vision"
    assert len(record["policy_sha256"]) == 64
    assert {pose.body for line in ticks for pose in line["poses"]} == {"vehicle", "payload"}
    assert len(ticks) > 200
    with raises(StorageError, match="holds a run already"):
        RunRecorder(run_folder, loaded)


CSV = "t,x,y,z,qx,qy,qz,qw,px,py,pz\n" + "".join(
    f"{0.01 * i:.3f},{0.3 * i:.2f},0,1333,0,0,0,1,{0.3 * i:.2f},0,950\n" for i in range(300)
)
HOLD = ("--set", "states.check_hold=2.0")
MAPPING = """
base = "hil/dry_run.toml"
[source]
kind = "csv"
file = "poses.csv"
senders = []
[source.time]
column = "t"

[[source.columns]]
name = "pos_w"
columns = ["x", "y", "z"]
unit = "mm"

[[source.columns]]
name = "quat_wb"
columns = ["qx", "qy", "qz", "qw"]
unit = "1"
kind = "quaternion"
[[source.columns]]
name = "payload_pos_w"
columns = ["px", "py", "pz"]
unit = "mm"
[frames.vehicle]
axes = "x,y,z"
body_axes = "x,y,z"
quaternion = "xyzw"
[frames.payload]
axes = "x,y,z"
"""


def test_the_policy_on_a_csv_file(tmp_path, monkeypatch, capsys, refused, printed):
    """``hil run`` on recorded poses: as fast as it goes, the policy asked at every tick, nothing
    released.
    """
    monkeypatch.chdir(tmp_path)
    (tmp_path / "poses.csv").write_text(CSV)
    (tmp_path / "mine.toml").write_text(MAPPING)
    assert run_command("hil run --config mine.toml --out run") == 0
    text = capsys.readouterr()
    assert "vehicle: 300 poses taken; refused: none" in text.out
    assert "throws 0, released 0" in text.out
    _, _, ticks = load_run("run")
    acted = [line for line in ticks if line["action"] is not None]
    assert len(acted) > 140
    assert len(acted[0]["keypoints"]) == 8
    vel = np.array(acted[-1]["observation"][3:6])
    np.testing.assert_allclose(vel, (0.03, 0.0, 0.0), atol=1e-4)
    assert run_command("hil replay run") == 0
    out = printed("hil check --config mine.toml --seconds 2")
    assert "PASS  all checks" in out
    assert "vehicle: 99 poses/s" in out
    assert "FAIL  all was well for the last " in printed(
        "hil check --config mine.toml --seconds 1.2", *HOLD, status=1
    )
    wrong = "--config mine.toml --set check.heading_deg=90.0"
    assert "FAIL  heading" in printed(f"hil check {wrong}", status=1)
    assert "throws 0" in printed(f"hil record {wrong} --set states.check=0.5 --out looked"), (
        "recorded to the end although the checks fail"
    )
    assert len(load_run("looked")[2]) == len(ticks)
    refused("hil run --config mine.toml --out run", message="holds a run already")


def test_a_run_whose_poses_cease_in_flight_is_packed_and_fails(tmp_path, monkeypatch, capsys):
    monkeypatch.chdir(tmp_path)
    rows = CSV.splitlines(keepends=True)
    (tmp_path / "poses.csv").write_text("".join([*rows[:220], rows[-1]]))
    (tmp_path / "mine.toml").write_text(MAPPING)
    assert run_command("hil run --config mine.toml --set observe=false --out run") == 1
    assert "run.zip  the run in one file" in capsys.readouterr().out
    assert (tmp_path / "run.zip").is_file()
