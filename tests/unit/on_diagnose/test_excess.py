"""Which latent forces are more than gusts."""

from types import SimpleNamespace

import numpy as np
from pytest import mark

from visthrow.diagnose.select import excess

PROBLEM = SimpleNamespace(model=SimpleNamespace(channels=("quat_wb", "pos_w")))


class Phase:
    """One whose level brings six nats over three times the quietest."""

    def __init__(self, point, phase):
        self.noise, self.phase = point.noise, phase

    def likelihood(self, block, level):
        return 6.0 * (level >= self.noise.latent_sd[block, self.phase])

    def upper_limit(self, block):
        return self.noise.latent_sd[block, self.phase]


@mark.parametrize(("metres_a_newton", "excessive"), [(1e-4, False), (1.0, True)])
def test_a_force_that_moves_no_landing_is_nothing_unknown(metres_a_newton, excessive, monkeypatch):
    """The throw's force of 10 N stands out from the calm phase's 1 N; it moves the vehicle by 1 mm
    in one case, by 10 m in the other.
    """
    monkeypatch.setattr(excess, "_Phase", Phase)
    sd = {(0, "calm"): 1.0, (0, "throw"): 10.0}
    window = SimpleNamespace(channel=np.array([0, 1]), latent=np.array([[1.0], [metres_a_newton]]))
    grams = [
        SimpleNamespace(phase=phase, latent_block=np.zeros(1, dtype=int), factor=np.eye(1))
        for _, phase in sd
    ]
    point = SimpleNamespace(noise=SimpleNamespace(latent_sd=sd), grams=grams, windows=[window] * 2)
    found = excess.levels(PROBLEM, point, point, 5.0)
    assert [level.excessive for level in found] == [False, excessive]
