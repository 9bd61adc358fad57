"""A run that ended other than well: one file that replays it, and where it went wrong in a
sentence.
"""

import errno
import shutil
import zipfile

from pytest import approx, fixture, raises

from hil.control.recording.record import pack
from hil.errors import RunError
from tests.commands import run_command
from tests.hil_runs import record_run, save_policy

LOST = 2.5
"""From which on no pose comes [s]: some ticks later the runner aborts."""


def stop(time, poses):
    return poses if time < LOST else []


@fixture(scope="module")
def aborted(tmp_path_factory):
    folder = tmp_path_factory.mktemp("run") / "a"
    decisions = record_run(folder, save_policy(folder.parent), seconds=6.0, poses=stop)
    return folder, decisions


def test_a_bundle_replays_to_the_bit_and_says_where_it_went_wrong(aborted, printed):
    folder, decisions = aborted
    turn = next(n for n, decision in enumerate(decisions) if decision.state == "abort")
    before = decisions[turn - 1].state
    bundle = pack(folder)
    assert bundle.parent == folder.parent
    out = printed(f"hil replay {bundle}")
    assert "all bit for bit the same" in out
    last_line = out.splitlines()[-1]
    assert last_line.startswith("It went wrong ")
    assert f"s into '{before}': {decisions[turn].reason}; the vehicle was at (" in last_line
    age = float(last_line.split(" ms old")[0].split()[-1])
    assert age == approx(1e3 * (decisions[turn].time - LOST), abs=25.0)


def test_a_full_disk_leaves_no_half_bundle(aborted, tmp_path, monkeypatch):
    folder = shutil.copytree(aborted[0], tmp_path / "full")
    write = zipfile.ZipFile.write

    def full(bundle, file, name):
        if name == "ticks.jsonl":
            raise OSError(errno.ENOSPC, "No space left on device")
        write(bundle, file, name)

    monkeypatch.setattr(zipfile.ZipFile, "write", full)
    with raises(RunError, match="cannot be written: No space left"):
        pack(folder)
    assert [path.name for path in tmp_path.iterdir()] == ["full"]


def test_a_run_that_was_killed_leaves_a_bundle_when_it_is_looked_at(tmp_path, printed):
    record_run(tmp_path / "b", save_policy(tmp_path), seconds=2.0, close=False)
    out = printed(f"hil replay {tmp_path}/b", status=1)
    assert "b.zip  what there is of the run" in out
    assert (
        "the recording ends" in printed(f"hil replay {tmp_path}/b.zip", status=1).splitlines()[-1]
    )


def test_of_a_run_without_a_tick_nothing_is_known(aborted, tmp_path, capsys):
    folder = shutil.copytree(aborted[0], tmp_path / "none")
    (folder / "ticks.jsonl").write_text("")
    assert run_command(f"hil replay {folder}") == 1
    assert (
        capsys.readouterr().out.splitlines()[-1]
        == "Whether it went wrong is not known: no tick is recorded."
    )


def test_what_is_no_bundle(tmp_path, refused):
    (tmp_path / "no.zip").write_bytes(b"PK no")
    refused(
        f"hil replay {tmp_path}/no.zip", message="expected a folder of a run, or the bundle of one"
    )
    with zipfile.ZipFile(tmp_path / "other.zip", "w") as bundle:
        bundle.writestr("holiday.txt", "x")
    refused(
        f"hil replay {tmp_path}/other.zip",
        message="other.zip: not the bundle of a run, it holds holiday.txt; expected config.toml",
    )
    with zipfile.ZipFile(tmp_path / "out.zip", "w") as bundle:
        bundle.writestr("../outside.txt", "x")
    assert run_command(f"hil replay {tmp_path}/out.zip") == 2
    assert not (tmp_path.parent / "outside.txt").exists()


def test_a_damaged_bundle_is_refused_in_a_sentence(aborted, tmp_path, refused):
    whole = bytearray(pack(aborted[0]).read_bytes())
    for at in range(200, 6000):  # within what is packed: bytes that no deflated block begins with
        whole[at] ^= 0xFF
    (tmp_path / "damaged.zip").write_bytes(whole)
    refused(
        f"hil replay {tmp_path}/damaged.zip",
        message="expected a folder of a run, or the bundle of one",
    )
