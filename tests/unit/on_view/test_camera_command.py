"""``visthrow camera``: a config from every kind of calibration, which then trains and flies;
whether a lens fits its pictures.
"""

import re
from pathlib import Path

import cv2
import numpy as np
from pytest import fixture, mark

from tests.boards import LENS, pictures
from tests.commands import run_command
from tests.lens_files import LENSES, kalibr_text


@fixture(scope="module")
def board(tmp_path_factory):
    """Give the words after a command that name a folder of pictures of a chessboard."""
    folder = tmp_path_factory.mktemp("board")
    for i, image in enumerate(pictures("chessboard")):
        cv2.imwrite(str(folder / f"{i}.png"), image)
    return [str(folder), "--board", *["chessboard", "7", "5", "0.04"]]


def calibrate(folder: Path) -> str:
    """Make a configuration of the boards' lens of its calibration; returns its path."""
    (folder / "kalibr.yaml").write_text(f"{kalibr_text(LENS)}  fov_deg: {LENS.fov_deg}\n")
    assert run_command(f"camera calibrate {folder}/kalibr.yaml --out {folder}/right.toml") == 0
    return f"{folder}/right.toml"


def test_check_tells_a_lens_that_fits_from_one_that_does_not(tmp_path, board, refused, printed):
    right = calibrate(tmp_path)
    assert "the configured lens fits" in printed(f"camera check {right}", *board)
    text = Path(right).read_text()
    (tmp_path / "wrong.toml").write_text(text.replace("fx = 96.0", "fx = 99.0"))
    assert "does NOT fit" in printed(f"camera check {tmp_path}/wrong.toml", *board, status=1)
    refused("camera check fisheye", *board, message="320 x 320 px came; expected 640 x 640")


def test_show_draws_corners_keypoints_and_a_straight_view(tmp_path, board, printed):
    out, frame = tmp_path / "seen.png", f"{board[0]}/0.png"
    command = f"camera show {calibrate(tmp_path)} {frame} --straight 100 --out {out}"
    output = printed(command, *board[1:])
    assert "4 of 4 keypoints of the goal, 4 of 4 of the payload" in output
    assert float(output.split("(blue): ")[1].split()[0]) < 0.2
    before, after = cv2.imread(frame), cv2.imread(str(out))
    coloured = np.ptp(after.astype(int), axis=-1) > 60
    assert coloured.sum() > 35 * 8, (
        "35 corners and the keypoints are drawn in colour on a grey picture"
    )
    assert np.ptp(before.astype(int), axis=-1).max() == 0
    assert cv2.imread(str(tmp_path / "seen_straight.png")).shape == (320, 320, 3)


def test_a_payload_below_the_ground_is_not_drawn(tmp_path, refused):
    refused(
        f"camera show fisheye --hangs 1.4 --out {tmp_path}/a.png",
        message="--hangs 1.4 below --height 1.333; expected a payload above the ground",
    )
    assert not (tmp_path / "a.png").exists()


@mark.parametrize(
    ("words", "message"),
    [
        (
            "{notes} --out {out}",
            "no camera of a known tool; expected one of basalt, kalibr, camodocal, svo",
        ),
        ("{ocam} --out {out}", "lines of numbers.*expected five"),
        ("{folder} --out {out}", r"--board \(missing\); expected --board chessboard"),
        (
            "{folder} --board charuco 7 5 0.04 --out {out}",
            "marker of 0.0 m; expected a side above 0",
        ),
        (
            "{folder} --board chessboard 7 5 0.04 --out {out}",
            "no picture in",
        ),
        ("{ocam} --out {notes}", r"notes\.txt; expected a file that ends in \.toml"),
    ],
)
def test_wrong_input_is_named(words, message, tmp_path, capsys):
    notes, ocam, folder = tmp_path / "notes.txt", tmp_path / "ocam.txt", tmp_path / "none"
    notes.write_text("not a calibration\n")
    ocam.write_text("\n".join(LENSES["ocam"]["text"].splitlines()[:9]))
    folder.mkdir()
    filled = words.format(notes=notes, ocam=ocam, folder=folder, out=tmp_path / "c.toml")
    assert run_command(f"camera calibrate {filled}") == 2
    assert re.search(message, capsys.readouterr().err)
    assert notes.read_text() == "not a calibration\n"
