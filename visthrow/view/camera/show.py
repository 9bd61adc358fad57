"""``visthrow camera show``."""

import argparse
from pathlib import Path

import cv2
import numpy as np
import torch

from camera.calibrate.boards import find_board, reprojected
from camera.fisheye import Fisheye
from camera.keypoints import KeypointCamera, keypoints
from camera.overlay import draw_overlay
from camera.params import CameraParams
from camera.rectify import ViewParams, rectify
from visthrow import config
from visthrow.common.errors import ConfigError
from visthrow.common.storage import atomic_write
from visthrow.view.camera.calibration import PICTURES, board_of, pictures_of, sentence

BLUE, YELLOW = (230, 120, 40), (60, 210, 240)
SAMPLES = 16
"""Rays a pixel of a rendered frame."""


def show(args: argparse.Namespace) -> int:
    """Write the picture, print what is in view."""
    params = config.load(CameraParams, config.find("camera", args.config))
    camera, lens = KeypointCamera(params), Fisheye(params.fisheye)
    pos_w, rot_wb = torch.tensor([0.0, 0.0, args.height]), torch.eye(3)
    ball_w, goal_w = pos_w - torch.tensor([0.0, 0.0, args.hangs]), torch.tensor([*args.target, 0.0])
    if args.picture is None:
        image = _rendered(params, pos_w, rot_wb, ball_w, goal_w)
    else:
        image = pictures_of([args.picture])[1][0]
    points, valid = keypoints(camera, pos_w[None], rot_wb[None], goal_w[None], ball_w[None])
    drawn = draw_overlay(camera, points[0], valid[0], image)
    if args.board:
        _draw_board(drawn, image, lens, args)
    out = Path(args.out)
    if out.suffix.lower() not in PICTURES:
        raise ConfigError(f"--out {out}; expected a picture, one of {', '.join(PICTURES)}")
    pictures = {out: drawn}
    if args.straight:
        pictures[out.with_name(f"{out.stem}_straight{out.suffix}")] = _straight(drawn, lens, args.straight)
    for path, picture in pictures.items():
        atomic_write(path, cv2.imencode(path.suffix, picture)[1].tobytes())
    seen = valid[0].tolist()
    print(sentence(params.fisheye))
    print(f"in view: {sum(seen[:4])} of 4 keypoints of the goal, {sum(seen[4:])} of 4 of the payload")
    print("\n".join(map(str, pictures)))
    return 0


def _rendered(
    params: CameraParams, pos_w: torch.Tensor, rot_wb: torch.Tensor, ball_w: torch.Tensor, goal_w: torch.Tensor
) -> np.ndarray:
    """Frame of a grey hall with ball and goal square, BGR, uint8."""
    from camera.detectors.scenes.renderer import Renderer
    from camera.detectors.scenes.scene import posed_scenes

    scenes = posed_scenes(params, pos_w[None], rot_wb[None], ball_w[None], goal_w[None], torch.tensor([True]))
    return np.ascontiguousarray(Renderer(params.fisheye, files=[], samples=SAMPLES).render(scenes)[0].numpy()[..., ::-1])


def _draw_board(drawn: np.ndarray, image: np.ndarray, lens: Fisheye, args: argparse.Namespace) -> None:
    board = board_of(args.board)
    view = find_board(image, board)
    if view is None:
        raise ConfigError(f"{args.picture or 'the rendered scene'}: no {board.pattern} of {board.columns} x {board.rows} points in it")
    expected = reprojected(lens, view)
    for pixels, colour, size in ((view.pixels, YELLOW, 5), (expected, BLUE, 2)):
        for u, v in pixels:
            cv2.circle(drawn, (round(u), round(v)), size, colour, 1, cv2.LINE_AA)
    off = np.sqrt(np.mean(np.sum((expected - view.pixels) ** 2, axis=1)))
    print(f"corners found (yellow) and reprojected (blue): {off:.3f} px rms")


def _straight(drawn: np.ndarray, lens: Fisheye, fov_deg: float) -> np.ndarray:
    """Rectified view of a drawn picture, BGR, uint8, square."""
    size = min(lens.params.width, lens.params.height)
    frames = torch.from_numpy(drawn).permute(2, 0, 1)[None].float() / 255.0
    flat = rectify(frames, lens, ViewParams(size, size, fov_deg))[0].permute(1, 2, 0)
    return (flat * 255.0).round().to(torch.uint8).numpy()
