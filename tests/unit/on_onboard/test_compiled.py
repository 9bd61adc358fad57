"""A compiled function gives the bits of the function itself and keeps nothing of a call."""

import copy

import numpy as np
import torch

from visthrow.onboard.compiled import Compiled
from visthrow.onboard.estimator import Estimator

CALLS = 60


def equal(compiled: Compiled, arrays: list[np.ndarray]) -> tuple[np.ndarray, ...]:
    """Return the results of a compiled function, which must be those of the function itself."""
    found, expected = compiled(*arrays), compiled.plain(*map(torch.from_numpy, arrays))
    assert len(found) == len(expected)
    for one, other in zip(found, expected):
        np.testing.assert_array_equal(one, other.numpy(), strict=True)
    return found


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
