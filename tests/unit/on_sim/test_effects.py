"""Effects on a plant's numbers, by numbers worked by hand."""

from dataclasses import replace

from pytest import approx, mark

from sim.effects.effect import Lowest
from sim.effects.setting import Setting
from tests.plants import paper_plant
from visthrow.config.effects import catalogue

MASS = "plant.rope.payload_mass"


@mark.parametrize(("share", "factor", "least"), [(1.0, 1.0, 0.01), (0.5, 0.1, 0.2)])
def test_the_lower_bound_leaves_what_the_limit_says(share, factor, least):
    setting = Setting(paper_plant())
    mass = setting.plant.rope.payload_mass
    effect = next(e for e in catalogue().values() if e.lowest)
    limits = (Lowest(MASS, share, factor, least),)
    effect = replace(effect, bounds=(-9.0, 9.0), lowest=limits)
    low, high = effect.bounded(setting).bounds
    assert high == 9.0
    assert mass + factor * low == approx((1.0 - share) * mass + factor * least)
