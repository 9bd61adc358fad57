"""The learnt detector's geometry, file and calibration; `visthrow detector check` measures its
detections.
"""

import math

import numpy as np
import torch
from pytest import approx, raises
from torch.testing import assert_close

from camera.detectors.learnt import (
    CELL,
    PATCH,
    LearntDetector,
    Networks,
    patches_of,
    places_of,
    views_about,
)
from camera.fisheye import Fisheye
from camera.params import FisheyeParams

LENS = Fisheye(FisheyeParams(320, 320, 80.0, 80.0, 159.5, 159.5, k1=0.01, fov_deg=200.0))
NORTH = torch.tensor([[0.0, -1.0, 0.0]])


def ray(theta: float, phi: float) -> torch.Tensor:
    return torch.tensor(
        [[math.sin(theta) * math.cos(phi), math.sin(theta) * math.sin(phi), math.cos(theta)]]
    )


def test_a_patch_is_upright_and_bent_by_no_lens():
    """Lines of constant azimuth and elevation about a ray, painted on a frame, stand straight in
    its patch.
    """
    about = ray(1.2, 0.7)
    views = views_about(about, torch.tensor([0.3]), NORTH)
    assert_close(views.axes[0] @ views.axes[0].T, torch.eye(3), atol=1e-6, rtol=0)
    assert (views.axes[0, 1] @ NORTH[0]) < 0.0, "down is away from north"
    v, u = torch.meshgrid(torch.arange(320.0), torch.arange(320.0), indexing="ij")
    rays, _ = LENS.unproject(torch.stack([u, v], -1).reshape(-1, 2))
    inside = views.points(rays[None])[0]
    ahead = rays @ views.axes[0, 2] > 0.3
    frame = torch.where(
        ahead[:, None],
        torch.cat([inside * 60.0 + 128.0, torch.full_like(inside[:, :1], 9.0)], -1).clamp(0, 255),
        0.0,
    )
    patch = patches_of(
        frame.reshape(1, 320, 320, 3).to(torch.uint8), torch.tensor([0]), views, LENS, 40
    )[0]
    at = (torch.arange(40) + 0.5) / 20.0 - 1.0
    expected = at * 60.0 + 128.0
    shown = (patch + 1.0) * 127.5
    assert (shown[0] - expected[None, :]).abs().max() < 2.0, "the columns of a patch"
    assert (shown[1] - expected[:, None]).abs().max() < 2.0, "its rows"
    points = torch.rand(1, 5, 2) - 0.5
    assert_close(views.points(views.rays(points)), points, atol=1e-6, rtol=0)


def test_places_are_where_the_grid_says():
    grids = torch.full((1, 2, 4, 20, 20), -6.0)
    grids[0, :, 1:] = 0.0
    grids[0, 0, :, 7, 12] = torch.tensor([5.0, 0.25, -0.5, math.log(0.5)])
    rays, sizes = places_of(grids, LENS)["ball"]
    pixel, _ = LENS.project(rays[:1])
    np.testing.assert_allclose(pixel[0].numpy(), [12.75 * CELL - 0.5, 7.0 * CELL - 0.5], atol=1e-3)
    assert sizes[0] == approx(0.5 * CELL / LENS.params.fx)


def test_networks_are_written_and_read(tmp_path):
    torch.manual_seed(0)
    made = Networks()
    made.calibration["ball"], made.made_by = (0.7, -0.2, 1.4), {"steps": 3}
    made.save(tmp_path / "a.npz")
    read = Networks.load(tmp_path / "a.npz")
    assert read.calibration["ball"] == (0.7, -0.2, 1.4)
    assert read.made_by == {"steps": 3}
    patch = torch.rand(2, 3, PATCH["goal"], PATCH["goal"])
    assert_close(read.goal(patch), made.goal(patch), atol=2e-3, rtol=0)
    with raises(ValueError, match="not a detector written by"):
        Networks.load(tmp_path / "none.npz")
    (tmp_path / "empty.npz").touch()
    with raises(ValueError, match="not a detector written by"):
        Networks.load(tmp_path / "empty.npz")
    (tmp_path / "b.npz").write_bytes((tmp_path / "a.npz").read_bytes()[:2000])
    with raises(ValueError, match="not a detector written by"):
        Networks.load(tmp_path / "b.npz")


def test_frames_of_another_size_are_refused():
    with raises(ValueError, match="expected multiples of 16 px"):
        LearntDetector(
            Fisheye(FisheyeParams(100, 100, 30.0, 30.0, 49.5, 49.5, fov_deg=180.0)),
            0.033,
            0.25,
            networks=Networks(),
        )
    detector = LearntDetector(LENS, 0.033, 0.25, networks=Networks())
    with raises(ValueError, match="expected"):
        detector.detect(np.zeros((10, 10, 3), np.uint8))
