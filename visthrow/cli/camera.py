"""Arguments of ``visthrow camera``. What an action needs is imported when it is chosen."""

import argparse

from camera.calibrate import BOARD
from visthrow.common.arguments import ABOVE_ZERO, NUMBER

TOOLS = (
    "Kalibr, OpenVINS, EuRoC, camodocal, VINS-Fusion, SVO, ORB-SLAM, basalt, ROS, OpenCV, OCamCalib"
)


EXAMPLES = f"""\
examples:
  visthrow camera calibrate camchain.yaml --out my_camera.toml
  visthrow camera calibrate boards/ --board chessboard 7 5 0.04 --fov-deg 190 --out my_camera.toml
  visthrow camera check my_camera.toml boards/ --board chessboard 7 5 0.04
  visthrow camera show my_camera.toml frame.png --target 1.5 0 --out seen.png
  visthrow train vision --set camera=my_camera.toml

A board is {BOARD}:
points (inner corners, or circles) along x and y, side of a square or distance of circles [m], side
of a marker [m].
"""


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Add the actions of the command."""
    parser.epilog = EXAMPLES
    actions = parser.add_subparsers(dest="action", metavar="ACTION", required=True)
    _add_calibrate(
        actions.add_parser(
            "calibrate", help="make a camera config from pictures of a board or another tool's file"
        )
    )
    check = actions.add_parser(
        "check",
        help=(
            "print a configuration's reprojection error on pictures of a board, and judge its lens"
        ),
    )
    check.add_argument("config", metavar="CONFIG", help="camera config: a shipped name or a file")
    check.add_argument(
        "pictures", nargs="+", metavar="FILE", help="pictures of a board, or a folder of them"
    )
    check.add_argument("--board", nargs="+", required=True, metavar="WORD", help=BOARD)
    _add_show(
        actions.add_parser(
            "show", help="draw field of view, keypoints and a board's corners on a picture"
        )
    )


def _add_calibrate(parser: argparse.ArgumentParser) -> None:
    parser.add_argument(
        "source",
        nargs="+",
        metavar="FILE",
        help=f"pictures, a folder of them, or one calibration file ({TOOLS})",
    )
    parser.add_argument("--board", nargs="+", metavar="WORD", help=f"of the pictures: {BOARD}")
    parser.add_argument(
        "--out", required=True, metavar="FILE", help="camera config to write (.toml)"
    )
    parser.add_argument(
        "--camera",
        default="0",
        metavar="N",
        help="number from 0, or name, of the camera in a file of several (default: 0)",
    )
    parser.add_argument(
        "--model",
        choices=("kb4", "radtan", "fov", "none"),
        help="distortion model, where the calibration file names none or a wrong one",
    )
    fov = (
        "full field of view; default: the file's own, else what the image's corners see; for"
        " pictures 180"
    )
    parser.add_argument("--fov-deg", type=ABOVE_ZERO, metavar="DEG", help=fov)
    like = "camera config that gives mount, noise and sizes (default: fisheye)"
    parser.add_argument("--like", default="fisheye", metavar="NAME", help=like)


def _add_show(parser: argparse.ArgumentParser) -> None:
    parser.add_argument("config", metavar="CONFIG", help="camera config: a shipped name or a file")
    parser.add_argument(
        "picture",
        nargs="?",
        metavar="FILE",
        help="picture of that camera; without it the scene is rendered",
    )
    parser.add_argument("--board", nargs="+", metavar="WORD", help=f"in the picture: {BOARD}")
    target = "target ahead and to the left (default: 1 0)"
    parser.add_argument(
        "--target", type=NUMBER, nargs=2, default=[1.0, 0.0], metavar="M", help=target
    )
    parser.add_argument(
        "--height",
        type=ABOVE_ZERO,
        default=1.333,
        metavar="M",
        help="of the hovering vehicle (default: 1.333)",
    )
    parser.add_argument(
        "--hangs",
        type=ABOVE_ZERO,
        default=0.383,
        metavar="M",
        help="of the payload's centre below it (default: 0.383)",
    )
    parser.add_argument(
        "--straight",
        type=ABOVE_ZERO,
        metavar="DEG",
        help="also write a rectified view this wide, below 180",
    )
    parser.add_argument(
        "--out",
        default="out/camera.png",
        metavar="FILE",
        help="picture to write (default: out/camera.png)",
    )


def run(args: argparse.Namespace) -> int:
    """Do what was asked."""
    from visthrow.view import camera_actions

    return {
        "calibrate": camera_actions.calibrate,
        "check": camera_actions.check,
        "show": camera_actions.show,
    }[args.action](args)
