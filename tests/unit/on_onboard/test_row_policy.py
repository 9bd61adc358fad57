"""A policy on arrays of one row acts as the policy on tensors does."""

from dataclasses import replace
from itertools import pairwise

import numpy as np
import torch
from numpy.testing import assert_allclose
from pytest import mark

from visthrow.onboard.estimator import Estimator
from visthrow.onboard.policy import ACTIVATIONS, Policy
from visthrow.onboard.row_policy import RowPolicy
from visthrow.onboard.shipped import SHIPPED

ROUNDING = 2e-6
"""Of outputs near 1: sums of float32 in another order."""

WIDE = 1e-5
"""With wide layers or large inputs; the memory carries the difference on."""

WIDTH = 9
STEPS = 20


def network(activation="elu", widths=(WIDTH, 16, 12, 5), **further):
    torch.manual_seed(3)
    weights = [0.3 * torch.randn(n, m) for m, n in pairwise(widths)]
    biases = [0.3 * torch.randn(n) for n in widths[1:]]
    return Policy(tuple(weights), tuple(biases), activation, {}, **further)


def estimator():
    """An estimator with two layers before its memory, the last of whose estimates keeps nothing."""
    draw = torch.randn
    return Estimator(
        mean=draw(WIDTH),
        std=0.5 + torch.rand(WIDTH),
        encoder_weight=0.3 * draw(8, WIDTH),
        encoder_bias=draw(8),
        input_weight=0.5 * draw(18, 9),
        input_bias=draw(18),
        memory_weight=0.5 * draw(18, 6),
        memory_bias=draw(18),
        output_weight=0.3 * draw(7, 6),
        output_bias=draw(7),
        kept=torch.tensor([*range(2, 8), WIDTH]),
        inner=((0.3 * draw(9, 8), draw(9)),),
    )


def assert_same(policy, scale=1.0, tolerance=ROUNDING):
    """The same actions and memory, step by step, from the same observations."""
    rows = RowPolicy(policy)
    memory = policy.begin(1)
    row_memory = memory.numpy()
    rng = np.random.default_rng(1)
    for _ in range(STEPS):
        obs = (scale * rng.standard_normal((1, policy.obs_dim))).astype(np.float32)
        action, memory = policy.step(torch.from_numpy(obs), memory)
        row_action, row_memory = rows.step(obs, row_memory)
        assert row_action.dtype == np.float32
        assert_allclose(row_action, action.numpy(), rtol=tolerance, atol=scale * tolerance)
        assert_allclose(row_memory, memory.numpy(), rtol=0.0, atol=tolerance)


@mark.parametrize("activation", ACTIVATIONS)
def test_every_activation(activation):
    assert_same(network(activation))


@mark.filterwarnings("error")
@mark.parametrize(("scale", "tolerance"), [(1.0, ROUNDING), (300.0, WIDE)])
def test_a_normaliser_and_a_memory(scale, tolerance):
    torch.manual_seed(5)
    normalizer = {"mean": torch.randn(7), "std": torch.rand(7), "eps": 0.01}
    policy = network(widths=(7, 16, 5), estimator=estimator(), **normalizer)
    assert_same(policy, scale, tolerance)
    assert_same(replace(policy, mean=None, std=None, eps=0.0), scale, tolerance)


@mark.parametrize("path", sorted(SHIPPED.glob("*.npz")), ids=lambda path: path.stem)
def test_shipped_policies(path):
    assert_same(Policy.load(path), tolerance=WIDE)
