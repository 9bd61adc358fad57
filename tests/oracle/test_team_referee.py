"""Two or three vehicles on one load against MuJoCo's bodies, with a release at two times."""

import numpy as np
from numpy.testing import assert_allclose
from pytest import mark

from tests.physics.test_team import around, commands, hang_level, plant
from visthrow.cooperative.referee import MujocoTeam

LOAD = 5e-4
"""Of the load after half a second [m]: 2 ms here, 0.5 ms and RK4 there; 0.2 mm was measured."""


@mark.parametrize("team", [2, 3])
def test_the_load_and_its_vehicles_fly_as_on_mujoco(team):
    sims = [hang_level(plant(), around(team), **options) for options in ({}, {"build": MujocoTeam})]
    for k, command in enumerate(commands(25, team)):
        command[1, 2] *= 0.7
        for sim in sims:
            sim.set_command(command, k == 16 + np.minimum(np.arange(team), 1))
            sim.step()
    tree, referee = sims
    assert not tree.get("attached").any()
    assert np.abs(tree.get("landing_w")[:, :2]).max() > 0.2
    assert_allclose(tree.load[0].numpy(), referee.load[0].numpy(), atol=LOAD)
    assert_allclose(tree.get("landing_w"), referee.get("landing_w"), atol=4.0 * LOAD)
    assert_allclose(tree.get("pos_w"), referee.get("pos_w"), atol=2.0 * LOAD)
