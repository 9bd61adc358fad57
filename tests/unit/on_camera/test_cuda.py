"""The camera inside a CUDA graph: replay equals eager."""

import torch
from pytest import mark

from camera.arrays import push
from camera.keypoint_noise import StepDraw, apply_noise
from camera.keypoints import KeypointCamera, keypoints
from camera.mount import rotation_from_vector
from camera.params import CameraParams, FisheyeParams, KeypointNoiseParams, MountParams

ENVIRONMENTS = 4096
BENT = FisheyeParams(640, 480, 160.0, 150.0, 310.0, 245.0, 0.02, -0.01, 0.002, -0.0002, 200.0)


@mark.gpu
@mark.skipif(not torch.cuda.is_available(), reason="needs a CUDA device")
def test_graph_replay_equals_eager():
    params = CameraParams(
        BENT, MountParams(), KeypointNoiseParams(drop_probability=0.1), 0.25, 0.033
    )
    camera = KeypointCamera(params, "cuda")
    normal = lambda *shape: torch.randn(ENVIRONMENTS, *shape, device="cuda")  # noqa: E731
    pose = [normal(3), rotation_from_vector(normal(3)), normal(2), normal(3)]
    extrinsics = camera.extrinsics(0.01 * normal(3), 0.01 * normal(3))
    draw = StepDraw(normal(8, 2), torch.rand(ENVIRONMENTS, 8, device="cuda"))
    reset = torch.rand(ENVIRONMENTS, device="cuda") < 0.1
    bias = torch.zeros(ENVIRONMENTS, 8, 2, device="cuda")
    history = torch.zeros(ENVIRONMENTS, 4, 8, 2, device="cuda")

    def step():
        points, valid = keypoints(camera, *pose, extrinsics)
        noisy, seen = apply_noise(params.noise, points, valid, bias, draw)
        history.copy_(push(history, noisy, reset))
        return noisy, seen

    stream = torch.cuda.Stream()
    with torch.cuda.stream(stream):
        step()
    torch.cuda.synchronize()
    graph = torch.cuda.CUDAGraph()
    with torch.cuda.graph(graph):
        noisy, seen = step()
    for tensor in (*pose[:1], pose[3], draw.normals):
        tensor.add_(0.1 * torch.randn_like(tensor))
    start = history.clone()
    graph.replay()
    torch.cuda.synchronize()
    replayed = (noisy.clone(), seen.clone(), history.clone())
    history.copy_(start)
    eager = (*step(), history)
    for one, other in zip(replayed, eager, strict=True):
        assert torch.equal(one, other)
