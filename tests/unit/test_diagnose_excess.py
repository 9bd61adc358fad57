"""Which latent forces are more than gusts."""

from types import SimpleNamespace

import pytest

from visthrow.diagnose.select import excess


class Phase:
    """One whose level brings six nats over three times the quietest."""

    def __init__(self, point, phase):
        self.noise, self.phase = point.noise, phase

    def likelihood(self, block, level):
        return 6.0 * (level >= self.noise.latent_sd[block, self.phase])

    def upper_limit(self, block):
        return self.noise.latent_sd[block, self.phase]


@pytest.mark.parametrize(("phases", "excessive"), [(2, True), (6, False)])
def test_of_many_levels_one_is_high_by_chance(phases, excessive, monkeypatch):
    """What is too much of one would be seen in one of a dozen of any null world's, at a threshold of five nats."""
    monkeypatch.setattr(excess, "_Phase", Phase)
    names = [f"phase {i}" for i in range(phases)]
    sd = {(0, name): 10.0 if name == names[-1] else 1.0 for name in names}
    point = SimpleNamespace(noise=SimpleNamespace(latent_sd=sd))
    found = excess.levels(point, point, 5.0)
    assert [level.nats for level in found] == [*[0.0] * (phases - 1), 6.0]
    assert [level.excessive for level in found] == [*[False] * (phases - 1), excessive]
