"""A compiled function gives the bits of the function itself and keeps nothing of a call."""

import copy

import numpy as np
import torch

from visthrow.onboard.compiled import Compiled


def equal(compiled: Compiled, arrays: list[np.ndarray]) -> tuple[np.ndarray, ...]:
    """Return the results of a compiled function, which must be those of the function itself."""
    found, expected = compiled(*arrays), compiled.plain(*map(torch.from_numpy, arrays))
    assert len(found) == len(expected)
    for one, other in zip(found, expected):
        np.testing.assert_array_equal(one, other.numpy(), strict=True)
    return found


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
