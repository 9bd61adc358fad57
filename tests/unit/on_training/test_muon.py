"""Muon: the trainings that step by it move a layer's weights alike in all directions."""

import torch
from pytest import mark

from tests.configs import load_experiment
from visthrow.training.trainer import Trainer

pytestmark = mark.usefixtures("one_thread")

ALIKE = 1.7
"""Largest singular value of a step over the fourth: Newton's iteration brings them to 0.7 to 1.2.
Of Adam, whose first step is the gradient's signs, it is more.
"""

SMALL = ["ppo.environments=32", "ppo.hidden=[24,24]", "ppo.epochs=1", "ppo.minibatches=1"]
DISTILLATION = [
    "distillation.hidden=24",
    "distillation.inner=[24]",
    "distillation.memory=16",
    "distillation.horizon=12",
    "distillation.minibatches=1",
]
TRAININGS = {
    "laptop_first_order": ["first_order.horizon=30"],
    "laptop_vision": DISTILLATION,
    "state_fast": ["ppo.critic=[24,24]", "ppo.steps=8"],
    "state": ["ppo.steps=8"],
}


@mark.parametrize("name", TRAININGS)
def test_steps_are_alike_in_all_directions_where_muon_takes_them(name):
    trainer = Trainer(load_experiment(name, [*SMALL, *TRAININGS[name]]), "cpu", 1)
    algorithm = trainer.algorithm
    network = algorithm.alg.actor if hasattr(algorithm, "alg") else algorithm.network
    (weight,) = (w for w in network.parameters() if w.shape == (24, 24))
    before = weight.detach().clone()
    trainer.step()
    sizes = torch.linalg.svdvals(weight.detach() - before)
    assert bool(sizes[0] < ALIKE * sizes[3]) == (name != "state")
