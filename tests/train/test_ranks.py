"""A training in two processes: one policy, separate data, and both resume."""

import socket
from pathlib import Path

import numpy as np
import torch
from numpy.testing import assert_array_equal
from pytest import fixture, mark

from tests.configs import load_experiment
from tests.train.conftest import PROCESSES
from visthrow.training.ranks import Ranks
from visthrow.training.trainer import Trainer

SMALL = ["ppo.environments=16", "ppo.hidden=[16,16]", "task.bounds.time_limit=0.4"]
PPO = ["ppo.steps=4", "ppo.minibatches=2"]
FIRST_ORDER = ['algorithm="first_order"', "ppo.minibatches=1", "first_order.horizon=12"]
DISTILLATION = [
    'algorithm="distillation"',
    "distillation.hidden=16",
    "distillation.memory=16",
    "distillation.horizon=8",
]
RUNS = {
    "ppo": ("state", PPO),
    "first_order": ("state", FIRST_ORDER),
    "distillation": ("vision", DISTILLATION),
}
PATIENCE = 300.0
"""Longest wait for what takes seconds on an idle machine [s]."""


def weights(trainer: Trainer) -> np.ndarray:
    policy = trainer.algorithm.export({}, {})
    tensors = policy.weights if policy.estimator is None else policy.estimator.parts().values()
    return torch.cat([t.float().flatten().cpu() for t in tensors]).numpy()


def process(rank: int, port: int, folder: Path) -> None:
    """Four iterations at a stretch, and two after a checkpoint that was written on the way."""
    import os

    os.environ |= {
        "RANK": str(rank),
        "LOCAL_RANK": str(rank),
        "WORLD_SIZE": "2",
        "MASTER_ADDR": "127.0.0.1",
        "MASTER_PORT": str(port),
    }
    torch.set_num_threads(1)
    ranks = Ranks.join(on_gpu=False)
    for name, (base, sets) in RUNS.items():
        experiment = load_experiment(base, [*SMALL, *sets])
        whole = Trainer(experiment, "cpu", 1, ranks)
        for _ in range(2):
            whole.step()
        whole.save(folder / f"{name}.pt")
        for _ in range(2):
            whole.step()
        resumed = Trainer(experiment, "cpu", 1, ranks)
        resumed.load(folder / f"{name}.pt")
        for _ in range(2):
            resumed.step()
        places = whole.algorithm.env.views.state["pos_w"].numpy().copy()
        np.savez(
            folder / f"{name}-{rank}.npz",
            whole=weights(whole),
            resumed=weights(resumed),
            places=places,
        )
    assert ranks.agree(3 * rank) == 3
    ranks.leave()


@fixture(scope="module")
def folder(tmp_path_factory):
    """Files of a training in two processes."""
    folder = tmp_path_factory.mktemp("ranks")
    with socket.socket() as free:
        free.bind(("127.0.0.1", 0))
        port = free.getsockname()[1]
    both = [
        PROCESSES.Process(target=process, args=(rank, port, folder), daemon=True)
        for rank in range(2)
    ]
    for one in both:
        one.start()
    for one in both:
        one.join(PATIENCE)
        assert one.exitcode == 0
    return folder


@mark.parametrize("name", RUNS)
def test_two_processes_learn_one_policy_from_separate_data(folder, name):
    first, second = (np.load(folder / f"{name}-{rank}.npz") for rank in range(2))
    assert_array_equal(first["whole"], second["whole"])
    assert not np.array_equal(first["places"], second["places"])


@mark.parametrize("name", RUNS)
def test_each_process_goes_on_bit_for_bit_where_it_was(folder, name):
    first = np.load(folder / f"{name}-0.npz")
    assert_array_equal(first["whole"], first["resumed"])


def test_a_process_that_a_checkpoint_does_not_know_starts_new_throws(folder):
    """Two processes' checkpoint taken up by three: the third must not collect the first one's data
    again.
    """
    experiment = load_experiment("state", [*SMALL, *PPO])
    first, third = (Trainer(experiment, "cpu", 1) for _ in range(2))
    third.ranks = Ranks(rank=2, world=3)
    for trainer in (first, third):
        trainer.load(folder / "ppo.pt")
    assert_array_equal(weights(first), weights(third))
    assert not torch.equal(
        first.algorithm.env.views.state["pos_w"], third.algorithm.env.views.state["pos_w"]
    )
