"""Calibrate a fisheye from pictures of a chessboard and write its camera configuration.

python examples/calibrate_camera.py pictures/*.png --columns 9 --rows 6 --square 0.03
"""

import argparse
from dataclasses import replace
from pathlib import Path

import cv2

from camera.calibrate.boards import BoardParams, calibrate_from_boards
from camera.params import CameraParams
from visthrow import config


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("pictures", nargs="+")
    parser.add_argument("--columns", type=int, required=True, help="inner corners along x")
    parser.add_argument("--rows", type=int, required=True, help="inner corners along y")
    parser.add_argument("--square", type=float, required=True, help="side of a square [m]")
    parser.add_argument("--out", type=Path, default=Path("my_camera.toml"))
    args = parser.parse_args()
    pictures = [cv2.imread(path) for path in args.pictures]
    board = BoardParams(args.columns, args.rows, args.square)
    fisheye, report = calibrate_from_boards(pictures, board)
    shipped = config.load(CameraParams, config.find("camera", "fisheye"))
    args.out.write_text(config.dumps(replace(shipped, fisheye=fisheye)), encoding="utf-8")
    print(f"{args.out}: {report.rms_px:.2f} px rms over {len(pictures)} pictures")


if __name__ == "__main__":
    main()
