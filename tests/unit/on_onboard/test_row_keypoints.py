"""One vehicle's keypoints on arrays equal those of the batched projection."""

from dataclasses import replace

import numpy as np
import torch
from numpy.testing import assert_allclose, assert_array_equal
from pytest import mark

from camera.keypoints import KeypointCamera, keypoints
from tests.configs import load_experiment
from visthrow.onboard.observations import rotation_from_quat
from visthrow.onboard.row_keypoints import row_keypoints

SINGLE = 2e-6
"""Of normalised points: float64 beside float32."""

LENSES = {
    "equidistant": {},
    "bent": {"k1": 0.01, "k2": -0.02, "k3": 0.003, "k4": 0.001},
    "larger than the sensor": {"width": 500, "cx": 230.0},
    "at the payload": {},
}


@mark.parametrize("reads", ["zero", "edge"])
@mark.parametrize("lens", LENSES)
def test_keypoints_are_those_of_the_batch(lens, reads):
    params = load_experiment("vision").camera
    params = replace(
        params,
        fisheye=replace(params.fisheye, **LENSES[lens]),
        noise=replace(params.noise, invalid_reads=reads),
    )
    if lens == "at the payload":
        params = replace(params, mount=replace(params.mount, position_b=(0.0, 0.0, 0.0)))
    camera = KeypointCamera(params)
    arrays = camera.convert_to_arrays()
    rng = np.random.default_rng(0)
    count = 200
    quat = rng.normal(size=(count, 4))
    pos = rng.normal(size=(count, 3)) + [0.0, 0.0, 2.0]
    payload = pos + 0.38 * rng.normal(size=(count, 3))
    if lens == "at the payload":
        payload[0] = pos[0]
    goal = rng.normal(size=(count, 3))
    quat /= np.linalg.norm(quat, axis=1, keepdims=True)
    views = [value.astype(np.float32) for value in (pos, quat, goal, payload)]
    pos, quat, goal, payload = map(torch.from_numpy, views)
    points, valid = keypoints(camera, pos, rotation_from_quat(quat), goal, payload)
    rows = []
    for k in range(count):
        pos, quat, goal, payload = (value[k : k + 1] for value in views)
        rows.append(row_keypoints(arrays, pos, rotation_from_quat(quat), goal, payload))
    assert_array_equal(np.concatenate([row_valid for _, row_valid in rows]), valid)
    assert_allclose(np.concatenate([place for place, _ in rows]), points, rtol=0.0, atol=SINGLE)
    assert 0.1 < valid.float().mean() < 0.9, "points inside and outside of the field of view"
