"""A compiled function gives the bits of the function itself and keeps nothing of a call."""

import copy

import numpy as np
import pytest
import torch

from hil.params import HilParams
from visthrow import config
from visthrow.onboard.compiled import Compiled
from visthrow.onboard.estimator import Estimator
from visthrow.onboard.pilot import VIEWS, Pilot
from visthrow.onboard.policy import Policy
from visthrow.onboard.shipped import find_policy

CALLS = 60


def equal(compiled: Compiled, arrays: list[np.ndarray]) -> tuple[np.ndarray, ...]:
    """Return the results of a compiled function, which must be those of the function itself."""
    found, expected = compiled(*arrays), compiled.plain(*map(torch.from_numpy, arrays))
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
@pytest.mark.parametrize("name", ["state", "vision", "vision_located", "vision_betaflight"])
def test_observation_and_decision_of_shipped_policies(name, count, given):
    pilot = Pilot(
        Policy.load(find_policy(name)),
        config.load(HilParams, config.find("hil", "fake")).camera,
        count,
    )
    rng, fits = np.random.default_rng(0), pilot.layout.fits
    history, answers, sums = pilot._history, pilot._answers, pilot._goal_fit
    previous, memory = pilot.previous_action, pilot._memory
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
        previous, *_, memory = equal(pilot._decide, [observation, memory])


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
    rng, compiled, held = (
        np.random.default_rng(0),
        Compiled(estimator.step),
        np.zeros((1, memory), dtype=np.float32),
    )
    for _ in range(CALLS):
        _, held = equal(compiled, [rng.normal(size=(1, width)).astype(np.float32), held])
    assert np.abs(held).max() > 0.01


def test_results_are_the_callers_own_and_arguments_stay():
    compiled = Compiled(lambda x: (x, x + 1.0))
    one, two = np.ones((1, 3), np.float32), np.full((1, 3), 2.0, np.float32)
    same, first = compiled(one)
    compiled(two)
    assert first.tolist() == [[2.0, 2.0, 2.0]]
    assert same.tolist() == one.tolist() == [[1.0, 1.0, 1.0]]
    first[:] = 9.0
    assert compiled(one)[1].tolist() == [[2.0, 2.0, 2.0]]


def test_a_copy_has_memory_of_its_own():
    compiled = Compiled(lambda x: (2.0 * (x[:, :1] + 0.1),))
    equal(compiled, [np.ones((1, 3), np.float32)])
    other = copy.deepcopy(compiled)
    equal(other, [np.full((1, 3), 2.0, np.float32)])
    equal(compiled, [np.full((1, 3), 3.0, np.float32)])
