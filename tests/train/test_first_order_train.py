"""First-order training through the command: its files. `test_ranks` resumes it."""

import numpy as np
import torch
from pytest import mark

from tests.commands import set_words
from tests.configs import load_experiment
from visthrow import cli
from visthrow.onboard.policy import Policy
from visthrow.task import contract_of
from visthrow.training.trainer import CHECKPOINT, Trainer

SMALL = [
    'algorithm="first_order"',
    "ppo.environments=16",
    "ppo.hidden=[16,16]",
    "ppo.minibatches=1",
    "task.bounds.time_limit=0.4",
    "first_order.horizon=12",
    "first_order.iterations=4",
]


def words(folder, *extra):
    command = f"train state --device cpu --out {folder} --checkpoint-every 1"
    return [*command.split(), *set_words(SMALL), *extra]


def test_its_policy_is_one_like_any_other(tmp_path):
    whole = tmp_path / "run"
    assert cli.main(words(whole)) == 0
    experiment = load_experiment(whole / "config.toml")
    policy = Policy.load(whole / "policy.npz")
    policy.require(contract_of(experiment))
    trainer = Trainer(experiment, "cpu", 1)
    trainer.load(whole / CHECKPOINT)
    obs = torch.randn(64, trainer.algorithm.env.layout.dimension)
    with torch.inference_mode():
        network = trainer.algorithm.average.module
        action = network.mlp(network.obs_normalizer(obs))
    assert (action - policy.act(obs)).abs().max() < 1e-6


@mark.parametrize(
    ("change", "message"),
    [
        ("first_order.horizon=5", "expected at least 7"),
        ("task.target.speed=[0.0,0.5]", "stationary goals"),
        ('task.observation.layout="vision"', 'layout = "state"'),
    ],
)
def test_what_it_cannot_train_is_refused(tmp_path, refused, change, message):
    refused(*words(tmp_path / "a", "--set", change), message=message)


@mark.gpu
def test_replayed_from_graphs_it_computes_what_it_computes_eagerly():
    """Six iterations: one launches, one captures, four replay, with fresh noise each."""

    def errors(eager):
        trainer = Trainer(load_experiment("state", SMALL), "cuda:0", 1)
        if eager:
            trainer.algorithm.rollout = trainer.algorithm._fly
            trainer.algorithm.backward = trainer.algorithm._run_backward
        return [trainer.step()["cost"] for _ in range(6)]

    captured = errors(False)
    assert len(set(captured)) == 6
    np.testing.assert_allclose(captured, errors(True), rtol=1e-3)
