"""A recorded function gives the bits of the function itself, whatever it is given, and keeps
nothing of a call.
"""

import copy

import numpy as np
import pytest
import torch
import torch.nn.functional as F

from hil.params import HilParams
from visthrow import config
from visthrow.onboard import traced
from visthrow.onboard.estimator import Estimator
from visthrow.onboard.pilot import VIEWS, Pilot
from visthrow.onboard.policy import Policy
from visthrow.onboard.shipped import find_policy
from visthrow.onboard.traced import Traced

CALLS = 60


def equal(traced: Traced, arrays: list[np.ndarray]) -> tuple[np.ndarray, ...]:
    """The results of a recorded function, once they are those of the function itself."""
    found, expected = traced(*arrays), traced.plain(*map(torch.from_numpy, arrays))
    assert len(found) == len(expected)
    for one, other in zip(found, expected):
        np.testing.assert_array_equal(one, other.numpy(), strict=True)
    return found


def drawn_views(rng: np.random.Generator, count: int) -> np.ndarray:
    """Vehicles over, beside and below a goal, at any attitude, with the payload near them."""
    parts = {name: rng.normal(size=(count, width)) for name, width in VIEWS.items()}
    parts["pos_w"][:, 2] += 1.0
    parts["quat_wb"] /= np.linalg.norm(parts["quat_wb"], axis=1, keepdims=True)
    parts["payload_w"] = parts["pos_w"] + 0.3 * parts["payload_w"]
    parts["attached"] = (parts["attached"] > 0.0).astype(float)
    return np.concatenate(list(parts.values()), axis=1).astype(np.float32)


@pytest.mark.parametrize("given", [False, True])
@pytest.mark.parametrize("count", [1, 3, 7])
@pytest.mark.parametrize("name", ["state", "vision", "vision_betaflight"])
def test_observation_and_decision_of_shipped_policies(name, count, given):
    pilot = Pilot(
        Policy.load(find_policy(name)),
        config.load(HilParams, config.find("hil", "fake")).camera,
        count,
    )
    rng, fits = np.random.default_rng(0), pilot.layout.fits
    history, answers, sums = pilot._history, pilot._answers, pilot._goal_fit
    previous, memory = pilot.previous_action, np.zeros((count, 0), dtype=np.float32)
    for step in range(CALLS):
        carried = [
            previous,
            history,
            np.full(count, step % 20 == 0),
            *([answers] if pilot.layout.response else []),
        ]
        carried += [sums, np.full(count, 0.02 * step, dtype=np.float32)] if fits else []
        points = rng.normal(scale=0.7, size=(count, 8, 2)).astype(np.float32)
        seen = [points, rng.random((count, 8)) > 0.4] if given else []
        observation, history, *rest = equal(
            pilot._observe, [drawn_views(rng, count), *carried, *seen]
        )
        answers, *rest = rest if pilot.layout.response else (answers, *rest)
        sums = rest[0] if fits else sums
        previous, *_ = equal(pilot._decide, [observation, memory])
    if name == "vision":
        assert len(pilot._observe._tape.steps) < len(pilot._observe._tape._calls), (
            "views and what nobody reads are left out"
        )


def test_a_memory_that_torch_writes_in_place():
    generator = torch.Generator().manual_seed(0)
    width, hidden, memory, count = 20, 16, 8, 12
    part = lambda *shape: 0.3 * torch.randn(*shape, generator=generator)  # noqa: E731
    estimator = Estimator(
        part(width),
        part(width).abs() + 1.0,
        part(hidden, width),
        part(hidden),
        part(3 * memory, hidden),
        part(3 * memory),
        part(3 * memory, memory),
        part(3 * memory),
        part(count, memory),
        part(count),
        torch.arange(count) + 3,
    )
    rng, traced, held = (
        np.random.default_rng(0),
        Traced(estimator.step),
        np.zeros((1, memory), dtype=np.float32),
    )
    for _ in range(CALLS):
        _, held = equal(traced, [rng.normal(size=(1, width)).astype(np.float32), held])
    assert np.abs(held).max() > 0.01


FUNCTIONS = {
    "a bound that float32 rounds": lambda x, y, n: (x < 0.1, x >= 0.1, x <= y, x > y),
    "arithmetic": lambda x, y, n: (
        x + 0.1,
        0.1 - x,
        x / 3.0,
        2.0 / x,
        -x * y,
        x - y,
        torch.add(x, y, alpha=0.3),
        (x * y).abs(),
    ),
    "bounds": lambda x, y, n: (
        x.clamp(min=0.1),
        x.clamp(max=0.1),
        x.clamp(-0.3, 0.3),
        torch.minimum(x, y),
        torch.maximum(x, y),
    ),
    "choices": lambda x, y, n: (
        torch.where(x > y, x, 0.0),
        torch.where(x > y, 1.0, y),
        torch.where(x[:, :1] > 0.0, x, y),
    ),
    "truths": lambda x, y, n: (
        (x > y) & (y > 0.0),
        (x > 0.0) | ~(y > 0.0),
        (x > 0.0).sum(-1),
        (x > 0.0).any(1),
        (x > y).all(),
    ),
    "whole numbers": lambda x, y, n: (
        n + 1,
        n * n,
        n.sum(),
        n / 2,
        n // 2,
        n * x,
        (n > 1) * y,
        n > 1,
        n.clamp(min=2),
        n.to(torch.float32),
    ),
    "parts": lambda x, y, n: (
        torch.cat([x, y[:, :0], y], 1),
        torch.stack([x, y], -1),
        F.pad(x, (1, 2)),
        x[:, [2, 0]],
        x.T.reshape(2, -1),
    ),
    "roots and angles": lambda x, y, n: (
        x.abs().sqrt(),
        x.atan(),
        x.sin(),
        x.cos(),
        x.square(),
        torch.linalg.cross(x[:, :3], y[:, :3]),
    ),
    "sums and products": lambda x, y, n: (
        x.sum(-1),
        x.mean(),
        x @ y.T,
        x.sort(1).values,
        torch.addcmul(x, x, y, value=0.7),
        x.norm(dim=1),
    ),
    "constants": lambda x, y, n: (
        torch.ones_like(x) * 2.0,
        torch.zeros(3) + 1.0,
        x * torch.eye(4),
        x[:, None].expand(-1, 2, -1) + 1.0,
    ),
    "its own, in place": lambda x, y, n: (
        (x * 2.0).add_(y).mul_(x),
        torch.empty_like(x).copy_(x) + y,
    ),
    "what came, and nothing else": lambda x, y, n: (x, y[:, 1:3], n),
}


@pytest.mark.parametrize("name", FUNCTIONS)
def test_operations_on_drawn_numbers(name):
    rng, traced = np.random.default_rng(0), Traced(FUNCTIONS[name])
    for number in range(CALLS):
        x, y = (
            rng.normal(size=(4, 4)).astype(np.float32) * 10.0 ** rng.integers(-3, 3) for _ in "xy"
        )
        x[0, 0], y[1, :2] = (
            (0.1, 0.0, -0.0, np.inf, -np.inf, np.nan)[number % 6],
            (
                x[1, 0],
                np.float32(0.1),
            ),
        )
        equal(traced, [x, y, rng.integers(0, 4, size=(4, 4))])


def test_results_are_the_callers_own_and_arguments_stay():
    traced = Traced(lambda x: (x, x + 1.0))
    one, two = np.ones((1, 3), np.float32), np.full((1, 3), 2.0, np.float32)
    same, first = traced(one)
    traced(two)
    assert first.tolist() == [[2.0, 2.0, 2.0]]
    assert same.tolist() == one.tolist() == [[1.0, 1.0, 1.0]]
    first[:] = 9.0
    assert traced(one)[1].tolist() == [[2.0, 2.0, 2.0]]


def test_other_shapes_and_types_are_recorded_anew():
    traced = Traced(lambda x: (x + 0.1,))
    for array in (
        np.ones((1, 3), np.float32),
        np.ones((2, 3), np.float32),
        np.ones((2, 3)),
        np.ones((1, 3), np.float32),
    ):
        equal(traced, [array])


def test_a_copy_has_memory_of_its_own():
    traced = Traced(lambda x: (2.0 * (x[:, :1] + 0.1),))
    equal(traced, [np.ones((1, 3), np.float32)])
    other = copy.deepcopy(traced)
    equal(other, [np.full((1, 3), 2.0, np.float32)])
    equal(traced, [np.full((1, 3), 3.0, np.float32)])


def test_a_recording_that_gives_other_numbers_is_refused(monkeypatch):
    monkeypatch.setitem(traced.EXACT, "add", np.subtract)
    with pytest.raises(RuntimeError, match=r"result 0 of .*lambda.* is another one"):
        Traced(lambda x: (x + 1.0,))(np.ones(3, dtype=np.float32))


def test_a_function_with_a_memory_is_refused():
    total = torch.zeros(1, 3)
    with pytest.raises(ValueError, match="add_ changes a tensor that the function did not make"):
        Traced(lambda x: (total.add_(x),))(np.ones((1, 3), np.float32))
